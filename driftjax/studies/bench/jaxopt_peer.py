"""Compare the bounded Newton method, which fits speed sets and GPs, with L-BFGS-B of jaxopt and automatic gradients.

Medians of up to 5 runs of each side, made in turn after compilation.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import RESULTS
from driftjax.core.bounded import minimise_within
from driftjax.explore import v_sets
from driftjax.explore.speed_sets import TOLERANCE, residuals
from driftjax.gp import fit_gp, fit_kernel
from driftjax.learning.reference import AIM_POINTS
from driftjax.studies.bench.rows import alternate, timed

BOUNDS = jnp.array([[-0.2, 0.2], [-0.5, 0.5], [-1.0, 1.0], [-3.0, 3.0]])  # of the speed increments [m/s]
V_MIN, V_MAX = 9.0, 13.2
WEIGHTS = ((1.0, 1.0), (0.01, 2.0), (100.0, 5.0), (500.0, 0.5))  # w1, w2; the third is the default of `learn`


def sample_corner(num: int) -> list[Array]:
    """Return V, s, r_b, e at `num` points of a corner of 25 m, with a lateral error that comes and goes."""
    rng = np.random.default_rng(0)
    s = np.cumsum(rng.uniform(0.6, 1.6, num)) * 25 / num
    V = 12.0 + 1.5 * np.cos(2 * np.pi * s / s[-1])
    return [
        jnp.asarray(a) for a in (V, s, np.full(num, 0.8), 1.2 * np.sin(np.pi * s / s[-1]) + 0.3 * rng.normal(size=num))
    ]


@jax.jit
def speed_sets(V: Array, s: Array, r_b: Array, e: Array, w1: Array, w2: Array):
    """Return the increments by the bounded Newton method, and how each ended."""
    sets = v_sets(V, s, r_b, e, w1=w1, w2=w2, gamma_bounds=BOUNDS, V_min=V_MIN, V_max=V_MAX)
    return sets.gamma, sets.result


@jax.jit
def speed_sets_jaxopt(V: Array, s: Array, r_b: Array, e: Array, w1: Array, w2: Array):
    """Return the same by jaxopt, to the same tolerance and with ten times the iterations."""

    def candidate(bounds: Array):
        lower, upper = (jnp.clip(bound, V_MIN - V, V_MAX - V) for bound in bounds)
        cost = lambda x: 0.5 * jnp.sum(residuals(x, V, s, r_b * e, w1, w2) ** 2)
        unit = jnp.maximum(1.0, jnp.max(jnp.abs(jax.grad(cost)(jnp.clip(r_b * e, lower, upper)))))
        end = minimise_within(lambda x: cost(x) / unit, r_b * e, lower, upper, tolerance=TOLERANCE, max_steps=1000)
        return end.x, end.result

    return jax.vmap(candidate)(BOUNDS)


def scaled_exponential(p: dict[str, Array], a: Array, b: Array) -> Array:
    """Return the covariance of two inputs."""
    return p["amplitude"] ** 2 * jnp.exp(-0.5 * jnp.sum(((a - b) / p["length"]) ** 2))


def side_by_side(ours: Callable[[], object], other: Callable[[], object]) -> tuple[float, float]:
    """Return the median times [ms] of two functions that are called in turn."""
    times = alternate(5, {"ours": timed(ours, 1), "other": timed(other, 1)})
    return 1e3 * times["ours"].median, 1e3 * times["other"].median


def compare_speed_sets() -> None:
    """Print both solvers of the speed sets."""
    for num in (AIM_POINTS, 60, 120):
        for weights in WEIGHTS:
            problem = (*sample_corner(num), *map(jnp.asarray, weights))
            (gamma, result), (other, ended) = speed_sets(*problem), speed_sets_jaxopt(*problem)
            ours, theirs = side_by_side(lambda: speed_sets(*problem), lambda: speed_sets_jaxopt(*problem))  # noqa: B023
            right = [int(jnp.sum(one == RESULTS.successful)) for one in (result, ended)]
            apart = float(jnp.abs(gamma - other).max())
            print(f"speed sets, {num} points, w {weights}: {ours:.3g} ms ({right[0]} of 4 converged), jaxopt "
                  f"{theirs:.3g} ms ({right[1]} of 4), ratio {theirs / ours:.3g}, apart {apart:.1e} m/s",
                  flush=True)  # fmt: skip


def compare_fits() -> None:
    """Print both fits of a GP with one output and three inputs, from four starts."""
    low, high = ({"amplitude": a, "length": np.full(3, l)} for a, l in ((0.05, 0.1), (20.0, 20.0)))
    for num in (50, 200, 500):
        rng = np.random.default_rng(0)
        Z = jnp.asarray(rng.normal(size=(num, 3)))
        y = jnp.sin(Z[:, 0]) + 0.5 * Z[:, 1] * Z[:, 2] + 0.1 * rng.normal(size=num)
        ours = lambda: fit_gp(Z, y)  # noqa: B023
        other = lambda: fit_kernel(scaled_exponential, Z, y, low, high, tolerance=2e-3, key=jax.random.key(0))  # noqa: B023
        first, second = side_by_side(ours, other)
        print(f"GP, {num} rows: {first:.3g} ms, jaxopt {second:.3g} ms, ratio {second / first:.3g}", flush=True)
