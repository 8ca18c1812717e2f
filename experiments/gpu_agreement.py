"""Compare a GPU with the CPU of the same machine, in float64: `python -m experiments.gpu_agreement`.

Simulator, GP and drift MPC, computed on both from the same inputs; prints the largest difference of each relative to
the largest value, and exits with 1 where one is above rounding.
"""

import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import driftjax as dj
from driftjax.studies.bench.drift import starts
from driftjax.studies.bench.mpc import example_gp, mpc_solves
from driftjax.studies.bench.simulator import double_track_steps

PLANTS, PROBLEMS, POINTS = 16, 64, 100
TOLERANCE = 1e-6  # of a value: above rounding through 300 plant steps, and the KKT tolerance of the MPC


def simulate() -> np.ndarray:
    """Return V of 16 random plants over 3 s."""
    steering, force = np.full(150, 0.08), np.linspace(0, 6000, 150)
    plants = dj.draw_plants("sedan", PLANTS, seed=1)
    return dj.simulate(plants, np.stack([steering, force], axis=1), dt=0.02, start=(12.0, 0.0, 0.0)).V.values


def step() -> np.ndarray:
    """Return the lateral speed of 4096 double-track cars after a step."""
    return np.asarray(double_track_steps("float64", 4096)().vy)


def fit_gp() -> np.ndarray:
    """Return the mean of a GP fitted to noisy samples."""
    rng = np.random.default_rng(0)
    Z = rng.uniform(-2, 2, (300, 2))
    gp = dj.fit_gp(Z, np.sin(2 * Z[:, 0]) + 0.1 * rng.standard_normal(300)).gp
    return np.asarray(jax.vmap(gp.mean)(jnp.asarray(Z)))


def solve_mpc() -> np.ndarray:
    """Return the optimal costs of 64 problems with a GP in the dynamics."""
    solved = mpc_solves("converged", starts(PROBLEMS), "float64", gp=example_gp(POINTS))()
    if not np.all(np.asarray(solved.solved)):
        raise RuntimeError("an MPC problem was not solved to the tolerance")
    return np.asarray(solved.cost)


PARTS: dict[str, Callable[[], np.ndarray]] = {
    "simulate": simulate, "double-track step": step, "GP fit": fit_gp, "MPC with GP": solve_mpc,
}  # fmt: skip


def on(device: Any, part: Callable[[], np.ndarray]) -> np.ndarray:
    """Return the values of `part` computed on `device`."""
    with jax.default_device(device):
        return part()


def main() -> int:
    """Print the largest relative difference of each part."""
    gpu, cpu, worst = jax.devices()[0], jax.devices("cpu")[0], 0.0
    if gpu.platform == "cpu":
        sys.exit("JAX finds no GPU here")
    print(f"{gpu.device_kind}, jax {jax.__version__}")
    for name, part in PARTS.items():
        ours, theirs = on(gpu, part), on(cpu, part)
        apart = float(np.max(np.abs(ours - theirs)) / np.max(np.abs(theirs)))
        worst = max(worst, apart if np.isfinite(apart) else np.inf)
        print(f"{name}: apart by at most {apart:.1e}", flush=True)
    return int(worst > TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
