"""Pure pursuit against the circle, LQR against SciPy, limits, reference tables, the residual's tangent."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from driftjax.control.drift_batch_ocp import DriftBatchOCP, to_batch_ocp
from driftjax.control.lqr import lqr, schedule_lqr
from driftjax.control.mpc import MPCConfig, Reference, Weights, drift_ocp, within_limits
from driftjax.control.pursuit import PursuitConfig, pure_pursuit
from driftjax.control.residual import residual_derivatives
from driftjax.control.table import ReferenceTable
from driftjax.core import BadInput, Control, State, features, rk4_step
from driftjax.gp import Hyper, condition, data_scales, zero_gp
from driftjax.track.build import from_curvature
from driftjax.vehicle import Residual, load_vehicle, no_residual

CAR = load_vehicle("sedan")
DRIFT = State(*(jnp.asarray(v) for v in (9.0, -0.54507, 1.1))), Control(jnp.asarray(-0.29676), jnp.asarray(6849.25))


@pytest.mark.parametrize("kappa", [0.04, -0.04, 0.0])
def test_pure_pursuit_steers_the_circle_its_rear_axle_is_on(kappa):
    # rear axle on the path and tangent to it: the circle through the target is the path, so tan(delta) = L kappa
    path = from_curvature([0.0, 100.0], [kappa, kappa], 3.0, 401)
    x, y, psi, _ = map(np.asarray, eqx.filter_jit(path.pose)(40.0))
    steer: Any = eqx.filter_jit(pure_pursuit(PursuitConfig(), CAR))
    u = steer(path, x + CAR.b * np.cos(psi), y + CAR.b * np.sin(psi), psi, jnp.asarray(8.0),
              jnp.asarray(8.0 * kappa), jnp.asarray(40.0), jnp.asarray(8.0), jnp.asarray(0.0))  # fmt: skip
    assert float(u.delta) == pytest.approx(np.arctan((CAR.a + CAR.b) * kappa), abs=1e-6)
    assert float(u.Fxr) == pytest.approx(0.0, abs=1e-9)


def test_pure_pursuit_accelerates_when_slow_and_steers_back_to_the_path():
    path = from_curvature([0.0, 100.0], [0.0, 0.0], 3.0, 101)
    steer: Any = eqx.filter_jit(pure_pursuit(PursuitConfig(speed_gain=2.0), CAR))
    at = lambda y, V, ax=0.0, r=0.0: steer(path, *(jnp.asarray(v) for v in (20.0, y, 0.0, V, r, 20.0, 10.0, ax)))
    assert float(at(0.0, 9.0).Fxr) == pytest.approx(CAR.m * 2.0 * 1.0)
    assert float(at(0.0, 12.0).Fxr) == pytest.approx(-CAR.m * 2.0 * 2.0)
    assert float(at(0.0, 10.0, 1.5).Fxr) == pytest.approx(CAR.m * 1.5)  # keeps a gaining plan without falling behind
    assert at(1.0, 10.0).delta < 0 < at(-1.0, 10.0).delta
    assert abs(at(1.0, 20.0).delta) < abs(at(1.0, 5.0).delta)  # looks further ahead when faster
    rear = CAR.m * CAR.a / (CAR.a + CAR.b)  # mass on the rear axle: it turns the car with r V and drives with the rest
    for r in (0.6, -0.6, 0.9):
        driving, braking = float(at(0.0, 10.0, 50.0, r).Fxr), float(at(0.0, 10.0, -50.0, r).Fxr)
        assert np.hypot(driving, rear * 10.0 * r) == pytest.approx(rear * 9.81 * CAR.mu) and braking == -driving
    assert abs(float(at(0.0, 10.0, 50.0, 1.2).Fxr)) < 1e-2 * rear * 9.81  # no grip is left


def one_step(ocp) -> DriftBatchOCP:
    """The equations of one problem."""
    one = jax.tree.map(lambda a: jnp.asarray(a)[None], ocp)
    return to_batch_ocp(one, one.u_scale[:, 1])


def test_along_a_constant_reference_the_scheduled_gains_are_those_of_the_discrete_riccati_equation(rate_factor=7.0):
    (x, u), weights = DRIFT, Weights((1.0, 700.0, 500.0), (30.0, 200.0))
    residual = no_residual(zero_gp(1, 5, 3))
    ocp = drift_ocp(MPCConfig(), weights, CAR, eqx.tree_at(lambda d: d.lags, residual, jnp.array([0.05, 0.1])))
    values = (x.V, x.r / x.V, x.V, x.beta, x.r, 0.0, -x.beta, u.delta, u.Fxr)
    table = ReferenceTable(0.0, 1.0, *(jnp.full(101, value) for value in values), drift_start=20.0, drift_end=40.0)
    gains = jax.jit(schedule_lqr, static_argnums=2)(ocp, table, 30, jnp.asarray(5.0), jnp.asarray(rate_factor))
    assert gains.s[0] == 15.0 and len(gains.s) == 30
    p, at = jax.tree.map(lambda a: a[0], table.reference(gains.s[:1])), jnp.stack(u) / ocp.u_scale
    z = jnp.concatenate([p.states(), at, at])
    equations, unit = one_step(ocp), np.asarray(ocp.u_scale)

    def after(z, u):
        """State, last command and actuator outputs one step later."""
        y = jnp.concatenate(equations.step([*z[:5, None], *z[7:, None]], [*u[:, None]], p))
        return jnp.concatenate([y[:5], u, y[5:]])

    A, B = (np.asarray(J) for J in jax.jit(jax.jacfwd(after, (0, 1)))(z, at))
    weight = np.diag(np.r_[ocp.Q, 0, 0, 0, 0])
    R = rate_factor * np.diag(np.asarray(ocp.R) * unit**2)
    change = np.eye(9)[5:7]
    P = solve_discrete_are(A, B, weight + change.T @ R @ change, R, s=-change.T @ R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A - R @ change)
    for gain in gains.K:
        np.testing.assert_allclose(gain, K, rtol=1e-5, atol=1e-7 * np.abs(K).max())
    assert np.max(np.abs(np.linalg.eigvals(A - B @ K))) < 1 < np.max(np.abs(np.linalg.eigvals(A)))
    state = jnp.concatenate([p.states(), jnp.stack(u), jnp.stack(u)])
    held = gains(ocp, jnp.asarray(22.3), state, state)
    np.testing.assert_allclose(held, jnp.stack(u), rtol=1e-12)


def test_the_lqr_gain_is_that_of_the_discrete_riccati_equation():
    (x, u), dt = DRIFT, 0.05
    nominal = CAR.build()
    Q, R = np.array([1.0, 700.0, 500.0]), np.array([10.0, 1e-9])
    gain = lqr(nominal, x, u, jnp.asarray(Q), jnp.asarray(R), jnp.asarray(dt))

    def step(x, u):
        return jnp.stack(rk4_step(lambda w: nominal(w, Control(u[0], u[1])), State(x[0], x[1], x[2]), dt))

    A, B = (np.asarray(J) for J in jax.jit(jax.jacfwd(step, (0, 1)))(np.stack(x), np.stack(u)))
    scaled = B / np.sqrt(R)  # the same problem in inputs of unit cost, well conditioned
    P = solve_discrete_are(A, scaled, np.diag(Q), np.eye(2))
    K = np.linalg.solve(np.eye(2) + scaled.T @ P @ scaled, scaled.T @ P @ A) / np.sqrt(R)[:, None]
    np.testing.assert_allclose(gain, K, rtol=1e-6)
    assert np.max(np.abs(np.linalg.eigvals(A))) > 1  # the drift is unstable without it
    assert np.max(np.abs(np.linalg.eigvals(A - B @ np.asarray(gain)))) < 1


limited: Any = eqx.filter_jit(within_limits)


@pytest.fixture(scope="module")
def ocp():
    return drift_ocp(MPCConfig(horizon=5), Weights(), CAR, no_residual(zero_gp(4, 5, 3)))


def test_inputs_are_brought_within_both_limits_and_left_alone_inside(ocp):
    rng = np.random.default_rng(0)
    wild = rng.normal(size=(40, 2)) * [1.0, 2e4]
    before = np.array([0.3, 1000.0])
    U = np.asarray(limited(ocp, wild, before, share=0.0))
    lower, upper, rate = (np.asarray(a) for a in (ocp.lower, ocp.upper, ocp.rate))
    change = np.diff(np.concatenate([before[None], U]), axis=0)
    assert np.all((U >= lower) & (U <= upper)) and np.all(np.abs(change) <= rate * (1 + 1e-12))
    np.testing.assert_allclose(rate, 0.05 * np.array([CAR.delta_rate_max, CAR.Fxr_rate_max]))
    # each change goes as far towards what was asked for as the limits let it
    first = np.clip(np.clip(wild[0], before - rate, before + rate), lower, upper)
    np.testing.assert_allclose(U[0], first)
    calm = np.tile(before, (3, 1)) + np.array([[0.01], [0.02], [0.01]]) * [1.0, 1000.0]
    np.testing.assert_allclose(limited(ocp, calm, before, share=0.0), calm)


def test_a_guess_lies_strictly_inside_the_limits(ocp):
    wild = jnp.asarray([[5.0, 1e5], [-5.0, -1e5]] * 20)
    before = jnp.asarray([0.0, 0.0])
    U = np.asarray(limited(ocp, wild, before))
    change = np.diff(np.concatenate([[[0.0, 0.0]], U]), axis=0)
    assert np.all(U > np.asarray(ocp.lower)) and np.all(U < np.asarray(ocp.upper))
    assert np.all(np.abs(change) < np.asarray(ocp.rate))


def test_the_prediction_holds_a_steady_drift_on_its_circle(ocp):
    x, u = DRIFT
    nominal = CAR.build()
    rates = np.abs(np.asarray(eqx.filter_jit(nominal)(x, u)))
    assert np.all(rates < [0.02, 0.02, 0.02])  # the state given is a drift to its printed digits
    zero, before = jnp.asarray(0.0), np.stack(u) / np.asarray(ocp.u_scale)
    start = np.array([x.V, x.beta, x.r, 0.0, -x.beta])
    p = Reference(zero, zero, zero, zero, zero, jnp.asarray(start[2] / start[0]))
    x, step = [*start[:, None], *before[:, None]], eqx.filter_jit(one_step(ocp).step)
    for _ in range(5):
        x = step(x, list(before[:, None]), p)
    np.testing.assert_allclose(np.ravel(x)[:5], start, atol=0.02)


def table() -> ReferenceTable:
    s = 2.0 + 0.5 * np.arange(9)
    columns = {name: jnp.asarray(i + s**2) for i, name in enumerate(
        ("speed", "kappa", "V", "beta", "r", "e", "theta", "delta", "Fxr"))}  # fmt: skip
    return ReferenceTable(2.0, 0.5, **columns, drift_start=3.0, drift_end=5.0)


def test_a_reference_table_is_linear_between_rows_and_constant_beyond():
    t: Any = table()
    at = np.array([-10.0, 2.0, 2.3, 4.75, 5.999, 6.0, 99.0])
    expected = np.interp(at, 2.0 + 0.5 * np.arange(9), np.asarray(t.V))
    row = eqx.filter_jit(t.row)
    np.testing.assert_allclose([float(row(t.V, jnp.asarray(s))) for s in at], expected, rtol=1e-12)
    reference = eqx.filter_jit(t.reference)(at)
    for i, name in ((1, "kappa"), (2, "V"), (3, "beta"), (4, "r"), (5, "e"), (6, "theta")):
        np.testing.assert_allclose(getattr(reference, name), expected - 2 + i, rtol=1e-12)
    x, u = eqx.filter_jit(t.state)(jnp.asarray(4.75))
    np.testing.assert_allclose([*x, *u], expected[3] - 2 + np.array([2, 3, 4, 7, 8]), rtol=1e-12)


def test_a_schedule_advances_at_the_speed_tracked():
    t: Any = table()
    s = np.asarray(eqx.filter_jit(t.schedule)(jnp.asarray(2.0), 3, jnp.asarray(0.01)))
    assert s[0] == 2.0
    V = np.asarray(eqx.filter_jit(eqx.filter_vmap(t.row, in_axes=(None, 0)))(t.V, s))
    np.testing.assert_allclose(np.diff(s), 0.01 * V[:-1], rtol=1e-12)
    np.testing.assert_allclose(eqx.filter_jit(t.inputs)(s), V[:, None] + [5.0, 6.0], rtol=1e-12)  # as `table` has it


def residual() -> Residual:
    rng = np.random.default_rng(3)
    Z = np.array([9.0, -0.5, 1.1, -0.3, 6800.0]) + rng.normal(size=(12, 5)) * [1, 0.1, 0.2, 0.1, 800.0]
    gp = conditioned(Z, rng.normal(size=(12, 3)))
    return Residual(gp, jnp.asarray([1.0, 0.4, 0.0]), jnp.asarray([0.05, 0.1]))


@jax.jit
def conditioned(Z, Y):
    mask, hyper = jnp.ones(12, bool), Hyper(jnp.zeros((3, 5)), jnp.zeros(3), jnp.full(3, jnp.log(0.1)))
    return condition(Z, Y, mask, hyper, *data_scales(Z, Y, mask), "se")


@pytest.mark.parametrize("bounded", [True, False])
def test_the_residual_near_a_point_has_its_value_and_its_derivatives(bounded):
    d: Any = dataclasses.replace(residual(), bounded=bounded)
    z = np.asarray(features(*DRIFT)) + [0.3, 0.05, -0.1, 0.02, 300.0]
    exact, bend = (np.asarray(jax.jit(by)(z)) for by in (jax.jacfwd(d), jax.jacfwd(jax.jacrev(d))))
    value = np.asarray(eqx.filter_jit(d)(z))
    several = np.stack([0.9 * z, z], axis=1)  # a batch of two
    leading = jax.tree.map(lambda a: jnp.asarray(a)[None], d)
    at = jax.jit(lambda z: residual_derivatives(leading, list(z), (1.0,) * 5))(several)
    np.testing.assert_allclose(np.asarray(at.d)[:, 1], value, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(at.J)[..., 1], exact, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(np.asarray(at.H)[..., 1], bend, rtol=1e-8, atol=1e-14)
    assert np.any(np.asarray(exact)[0] != 0) and np.all(value[:2] != 0)
    assert value[2] == 0  # gated off


def test_far_from_data_a_bounded_residual_fades_and_a_free_one_is_the_mean():
    bounded = residual()
    far = np.asarray(bounded.gp.Z)[0] + 8 * np.asarray(bounded.gp.scale)
    free = dataclasses.replace(bounded, bounded=False)
    stretched = eqx.tree_at(lambda d: d.gp.hyper.log_lengthscale, free, jnp.full((3, 5), 3.0))
    at = eqx.filter_jit(lambda d: d(far))
    assert np.all(np.abs(at(dataclasses.replace(stretched, bounded=True))) < 1e-3)
    mean = np.asarray(eqx.filter_jit(stretched.gp.mean)(far))
    np.testing.assert_allclose(at(stretched), np.asarray(stretched.trust_factor) * mean, rtol=1e-12)
    assert np.all(np.abs(np.asarray(at(stretched))[:2]) > 0.02)


def test_no_residual_is_zero_everywhere():
    d = no_residual(residual().gp)
    assert bool(jnp.all(d(features(*DRIFT)) == 0))


@pytest.mark.parametrize(
    "config, change",
    [(MPCConfig(), {"horizon": 0}), (MPCConfig(), {"dt": -1.0}), (MPCConfig(), {"R": (0.0, 1.0)}),
     (PursuitConfig(), {"preview_min": 0.0})],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused_by_name(config, change):
    with pytest.raises(BadInput, match=next(iter(change))):
        dataclasses.replace(config, **change)
