"""The drift MPC for batches is the drift MPC of closed-loop laps, entry by entry."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.batch_solve import MIN_BATCH, MPCProblem, solve_mpc_batch, solve_with_fallback
from driftjax.control.drift_batch_ocp import drift_batch_ocp
from driftjax.control.mpc import MPCConfig, Reference, Weights, drift_ocp
from driftjax.gp import Hyper, condition, data_scales, zero_gp
from driftjax.solve import Options
from driftjax.vehicle import Residual, load_vehicle, no_residual

CAR, CONFIG = load_vehicle("sedan"), MPCConfig(horizon=4)
UNIT = np.array([1.0, 1000.0])
WHOLE = Weights(Q_path=(200.0, 100.0), front_slip=1000.0)
X, U, BEFORE = np.array([8.7, -0.6, 1.2, 0.3, 0.2]), np.array([-0.2, 6.0]), np.array([-0.25, 6.5])


def residual(seed: int, size: float = 1.0, num: int = 12) -> Residual:
    """Something learnt near the drift, and lags."""
    rng = np.random.default_rng(seed)
    Z = np.array([9.0, -0.55, 1.1, -0.3, 6800.0]) + rng.normal(size=(num, 5)) * [0.7, 0.1, 0.15, 0.1, 800.0]
    Y = size * rng.normal(size=(num, 3)) * [0.5, 0.1, 0.3]
    return Residual(conditioned(Z, Y), jnp.array([1.0, 0.8, 0.9]), jnp.array([0.06, 0.09]))


@jax.jit
def conditioned(Z, Y):
    mask, hyper = jnp.ones(len(Z), bool), Hyper(jnp.full((3, 5), 0.7), jnp.zeros(3), jnp.full(3, -2.0))
    return condition(Z, Y, mask, hyper, *data_scales(Z, Y, mask), "se")


def reference(num: int, *shape: int) -> Reference:
    columns = (np.full((num, *shape), value) for value in (9.0, -0.55, 1.1, 0.1, 0.15, 0.06))
    return Reference(*map(jnp.asarray, columns))


CASES = {"the paper's": (Weights(), None), "all": (WHOLE, residual(0))}
NAMES = (pytest.param("the paper's", marks=pytest.mark.slow), "all")


@eqx.filter_jit
def batched_values(batched, z, costate, p):
    """Everything about one step at states and inputs `z`, in one program for all sampling times."""
    x, u = [z[i : i + 1] for i in range(len(z) - 2)], [z[-2:-1], z[-1:]]
    expansion = batched.local_expansion(x, u, p)
    y, M, more = batched.linearise(x, u, p, expansion)
    args = (x, u, [c[None] for c in costate], p, more)
    return (
        (y, M),
        batched.step(x, u, p),
        batched.cost(x, u, p),
        batched.curvature(*args),
        batched.early_curvature(*args),
    )


@pytest.mark.parametrize("name", NAMES)
def test_step_derivatives_and_costs_are_those_of_the_whole_problem(name):
    weights, learnt = CASES[name]
    ocp = drift_ocp(CONFIG, weights, CAR, no_residual(zero_gp(1, 5, 3)) if learnt is None else learnt)
    batched = drift_batch_ocp(CONFIG, weights, CAR, learnt)
    reached = [-0.22, 6.3] if batched.lags is not None else []
    tracked = list(X[: len(batched.Q)])
    here = jax.tree.map(lambda a: np.asarray(a)[0], reference(5))
    acting = reached or list(U)  # a state that no lag remembers has no effect
    unscale = np.concatenate([np.ones(5), UNIT, UNIT])  # from SI to the units of the batch
    kept = [*range(len(tracked)), *((7, 8) if reached else ())]
    to_z = np.concatenate([ocp.x_scale / unscale, np.asarray(ocp.u_scale) / UNIT])

    @jax.jit
    def value(z):
        """The whole problem in the units of the batch: next state (kept entries) and cost less that of the change."""
        full = jnp.concatenate([jnp.asarray(X), BEFORE, jnp.asarray(acting)]).at[jnp.array(kept)].set(z[:-2])
        x, u = full * unscale / ocp.x_scale, z[-2:] * UNIT / ocp.u_scale
        change = jnp.sum(ocp.R * ((z[-2:] - BEFORE) * UNIT) ** 2)
        return (ocp.step(x, u, here) * to_z[:9])[jnp.array(kept)], ocp.cost(x, u, here) - change

    z = np.array([*tracked, *reached, *U])
    p = jax.tree.map(lambda a: np.asarray(a)[0], reference(1, 1))
    costate = np.random.default_rng(1).normal(size=len(kept))

    (y, M), after, cost, *_ = batched_values(batched, z, costate, p)
    np.testing.assert_allclose(np.ravel(y), value(z)[0], rtol=1e-12)
    np.testing.assert_allclose(np.ravel(after), value(z)[0], rtol=1e-12)
    exact = jax.jit(jax.jacfwd(lambda z: value(z)[0]))(z)
    np.testing.assert_allclose(dense(M), exact, rtol=1e-8, atol=1e-10 * np.abs(exact).max())
    np.testing.assert_allclose(cost[0], value(z)[1], rtol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_second_derivatives_are_exact_and_the_early_ones_become_so_with_short_steps(name):
    weights, learnt = CASES[name]
    problem = lambda dt: drift_batch_ocp(replace(CONFIG, dt=dt), weights, CAR, learnt)
    p = jax.tree.map(lambda a: np.asarray(a)[0], reference(1, 1))
    z = np.array([*X[: len(problem(CONFIG.dt).Q)], *([] if learnt is None else [-0.22, 6.3]), *U])
    costate = np.random.default_rng(1).normal(size=len(z) - 2)

    def errors(dt: float) -> list[float]:
        """Largest, over the largest second derivative; of what is multiplied by dt; of exact and early ones."""
        batched, steps = problem(dt), 1e-5 * np.eye(len(z))
        slope = lambda z: pulled(batched_values(batched, z, costate, p)[0][1], costate)
        bend = np.array([slope(z + step) - slope(z - step) for step in steps]) / 2e-5
        return [np.abs(dense(H) - bend).max() / np.abs(bend).max() for H in batched_values(batched, z, costate, p)[3:]]

    (exact, early), (_, middle), (_, short) = map(errors, (0.05, 0.02, 0.005))
    assert exact < 1e-6
    assert early < 0.2
    assert short < middle / 10


def dense(rows) -> np.ndarray:
    return np.array([[0.0 if e is None else np.ravel(e)[0] for e in row] for row in rows])


def pulled(M, costate) -> np.ndarray:
    """Return the entries of costate' M."""
    product = lambda j: sum(c * np.ravel(row[j])[0] for c, row in zip(costate, M, strict=True) if row[j] is not None)
    return np.array([product(j) for j in range(len(M[0]))])


@pytest.mark.slow
def test_many_laps_at_once_are_answered_as_each_alone(tmp_path):
    """In a process of its own: XLA reads the flag, without which this program takes minutes to compile, only once."""
    fused = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true"
    out = tmp_path / "results.npz"
    code = f"import test_drift_batch; test_drift_batch.answer({str(out)!r})"
    paths = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[2])])
    env = os.environ | {"XLA_FLAGS": fused, "PYTHONPATH": paths, "JAX_ENABLE_X64": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    results = np.load(out)
    assert results["num_steps"][0] == 0  # not needed
    assert (results["kkt"][1:] <= 1e-8).all() and (results["kkt_alone"][1:] <= 1e-8).all()
    np.testing.assert_allclose(results["U"][1:] / UNIT, results["U_alone"][1:] / UNIT, atol=1e-6)
    np.testing.assert_allclose(results["X"][1:], results["X_alone"][1:], atol=1e-6)


def answer(out: str) -> None:
    """Batched and fallback solutions of entries with different residuals; the first is not needed."""
    num, config = MIN_BATCH, MPCConfig(horizon=6, tolerance=1e-8, max_steps=60)
    problems = [drift_ocp(config, WHOLE, CAR, residual(seed % 4, 0.2)) for seed in range(num)]
    ocp = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)
    x = X + np.random.default_rng(0).uniform(-0.05, 0.05, (num, 5))
    wide = lambda a: jnp.broadcast_to(a, (num, *np.shape(a)))
    before = wide(BEFORE * UNIT)
    options = Options(*(jnp.full(num, value) for value in (1e-8, 1.0, 60, 1.0)))
    problem = MPCProblem(jnp.asarray(x), before, before, jax.tree.map(wide, reference(7)), wide(np.tile(X, (7, 1))),
                  wide(np.tile(BEFORE * UNIT, (6, 1))), options)  # fmt: skip
    together = eqx.filter_jit(solve_mpc_batch)(ocp, problem, jnp.arange(num) > 0)
    alone = eqx.filter_jit(eqx.filter_vmap(solve_with_fallback))(ocp, problem)
    np.savez(out, **together._asdict(), **{f"{name}_alone": value for name, value in alone._asdict().items()})
