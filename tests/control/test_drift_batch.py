"""The drift MPC for batches is the drift MPC of closed-loop laps, entry by entry."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.drift_batch_ocp import drift_batch_ocp, to_batch_ocp
from driftjax.control.mpc import DriftOCP, MPCConfig, Reference, Weights, drift_ocp
from driftjax.control.mpc_solution import MPCProblem, solve_mpc_batch
from driftjax.core import Control, State, features, lag_step, rk4_step
from driftjax.gp import Hyper, condition, data_scales, zero_gp
from driftjax.solve import Options
from driftjax.track import curvilinear_rates
from driftjax.vehicle import Extended, Residual, beyond_peak, build_car, load_vehicle, no_residual

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


def whole_problem(ocp: DriftOCP, z, p, lagged: bool):
    """Eq. 10 written down once more, in the units of the batch: next state, cost without that of the change."""
    n = 5 if lagged else 3
    y = jnp.concatenate([z[:n], jnp.asarray(X)[n:]])
    lagged_input, u = (z[n : n + 2] if lagged else z[-2:]) * UNIT, z[-2:] * UNIT
    acting, end = lag_step(lagged_input, u, ocp.residual.lags, ocp.dt)
    control = Control(acting[0], acting[1])
    d = ocp.residual(features(State(y[0], y[1], y[2]), control))

    def rates(w):
        dx = jnp.stack(ocp.nominal(State(w[0], w[1], w[2]), control)) + d
        return jnp.concatenate([dx, jnp.stack(curvilinear_rates(w[0], w[1], w[2], w[3], w[4], p.kappa)[1:])])

    tracked = rk4_step(rates, y, ocp.dt)[:n]
    beyond = beyond_peak(ocp.nominal, State(y[0], y[1], y[2]), control)
    cost = jnp.sum(ocp.Q * (y - p.states()) ** 2) + ocp.front_slip * beyond**2
    return jnp.concatenate([tracked, end / UNIT]) if lagged else tracked, cost


@pytest.mark.parametrize("name", NAMES)
def test_step_derivatives_and_costs_are_those_of_the_whole_problem(name):
    weights, learnt = CASES[name]
    ocp = drift_ocp(CONFIG, weights, CAR, no_residual(zero_gp(1, 5, 3)) if learnt is None else learnt)
    batched = drift_batch_ocp(CONFIG, weights, CAR, learnt)
    here = jax.tree.map(lambda a: np.asarray(a)[0], reference(5))
    z = np.array([*X[: len(batched.Q)], *([] if batched.lags is None else [-0.22, 6.3]), *U])
    p = jax.tree.map(lambda a: np.asarray(a)[0], reference(1, 1))
    costate = np.random.default_rng(1).normal(size=len(z) - 2)
    value = jax.jit(lambda z: whole_problem(ocp, z, here, batched.lags is not None))

    (y, M), after, cost, *_ = batched_values(batched, z, costate, p)
    np.testing.assert_allclose(np.ravel(y), value(z)[0], rtol=1e-12)
    np.testing.assert_allclose(np.ravel(after), value(z)[0], rtol=1e-12)
    exact = jax.jit(jax.jacfwd(lambda z: value(z)[0]))(z)
    np.testing.assert_allclose(dense(M), exact, rtol=1e-8, atol=1e-10 * np.abs(exact).max())
    np.testing.assert_allclose(cost[0], value(z)[1], rtol=1e-12)


def test_cars_with_parameters_of_their_own_are_linearised_side_by_side():
    vehicle, effects = replace(CAR, combined_slip=1.0), ("friction_rear", "drive_gain")
    car = build_car(vehicle, effects)
    assert isinstance(car, Extended)
    thetas = np.array([[0.0, 0.0], [-1.5, 1.0], [1.0, -0.5]])
    learnt = no_residual(zero_gp(1, 5, 3))
    each = [drift_ocp(CONFIG, Weights(), vehicle, learnt, car.with_parameters(jnp.asarray(t))) for t in thetas]
    ocp = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    batched = to_batch_ocp(ocp, jnp.full(len(each), UNIT[1]), path=False, residual=False, lags=False)
    p, z = jax.tree.map(lambda a: a[0], reference(1, len(each))), [*X[:3], *U]
    x, u = ([jnp.full(len(each), value) for value in some] for some in (z[:3], z[3:]))
    y, M, _ = eqx.filter_jit(lambda batched, *args: batched.linearise(*args, None))(batched, x, u, p)

    def alone(ocp, z):
        control = Control(z[3], z[4] * UNIT[1])
        return rk4_step(lambda w: jnp.stack(ocp.nominal(State(*w), control)), z[:3], ocp.dt)

    values, slopes = eqx.filter_jit(jax.vmap(lambda ocp, z: (alone(ocp, z), jax.jacfwd(alone, 1)(ocp, z)), (0, None)))(
        ocp, jnp.array(z)
    )
    assert np.ptp(values, axis=0).min() > 1e-4  # another car, another step
    np.testing.assert_allclose(np.transpose(y), values, rtol=1e-12)
    entries = np.array([[np.zeros(len(each)) if e is None else e for e in row] for row in M])
    np.testing.assert_allclose(np.moveaxis(entries, -1, 0), slopes, rtol=1e-8, atol=1e-10 * np.abs(slopes).max())


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


NUM = 20


@pytest.mark.slow
def test_a_batch_is_solved_as_each_problem_alone():
    """Entries with different residuals; the first is not needed."""
    config = MPCConfig(horizon=6, tolerance=1e-8, max_steps=60)
    problems = [drift_ocp(config, WHOLE, CAR, residual(seed % 4, 0.2)) for seed in range(NUM)]
    ocp = jax.tree.map(lambda *leaves: jnp.stack(leaves), *problems)
    x = X + np.random.default_rng(0).uniform(-0.05, 0.05, (NUM, 5))
    wide = lambda a: jnp.broadcast_to(a, (NUM, *np.shape(a)))
    before = wide(BEFORE * UNIT)
    options = Options(*(jnp.full(NUM, value) for value in (1e-8, 1.0, 60, 1.0, 0)))
    problem = MPCProblem(jnp.asarray(x), before, before, jax.tree.map(wide, reference(7)), wide(np.tile(X, (7, 1))),
                  wide(np.tile(BEFORE * UNIT, (6, 1))), options)  # fmt: skip
    needed = jnp.arange(NUM) > 0
    together = eqx.filter_jit(solve_mpc_batch)(ocp, problem, needed)
    solve = eqx.filter_jit(solve_mpc_batch)
    alone = [solve(*jax.tree.map(lambda a, i=i: a[i : i + 1], (ocp, problem))) for i in range(NUM)]
    separate = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *alone)
    assert int(together.plan.num_steps[0]) == 0  # not needed
    assert bool(jnp.all(together.plan.kkt[1:] <= 1e-8)) and bool(jnp.all(separate.plan.kkt <= 1e-8))
    np.testing.assert_allclose(together.U[1:] / UNIT, separate.U[1:] / UNIT, atol=1e-6)
    np.testing.assert_allclose(together.X[1:], separate.X[1:], atol=1e-6)
