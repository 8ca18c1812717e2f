"""Residual rates out of a driven lap: a planted one comes back, and only drifted rows count."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.driver import Decision
from driftjax.core import Control, State, rk4_step
from driftjax.learning import residual
from driftjax.sim import Sensed, Trace
from driftjax.vehicle import Corrected, load_vehicle

NOMINAL = load_vehicle("sedan").build()
DT, T = 0.05, 40
NONE = np.zeros(2)  # no lags
lag_response, lagged_input, smooth = map(jax.jit, (residual.lag_response, residual.lagged_input, residual.smooth))
compiled: Any = eqx.filter_jit
residual_rate, estimate_lags, samples, rows = map(
    compiled, (residual.residual_rate, residual.estimate_lags, residual.samples, residual.rows)
)
PLANTED = np.array([0.4, -0.15, 0.3])
X0 = State(*(jnp.asarray(v) for v in (9.0, -0.54507, 1.1)))
U0 = Control(jnp.asarray(-0.29676), jnp.asarray(6849.25))


def driven(x0: State = X0, command: Control | None = None, lags=(0.0, 0.0)) -> tuple[State, Control]:
    """States of the nominal car with the planted rate behind lagging actuators, and the moving commands."""
    t = DT * np.arange(T)
    u = (
        Control(*map(jnp.asarray, (U0.delta + 0.02 * np.sin(t), U0.Fxr + 200.0 * np.cos(t))))
        if command is None
        else command
    )
    return jax.device_get(_states(x0, u, jnp.asarray(lags))), u


@jax.jit
def _states(x0: State, command: Control, lags) -> State:
    model = Corrected(NOMINAL, lambda z: jnp.asarray(PLANTED))
    acting = Control(*(lagged_input(one, lag, jnp.asarray(DT)) for one, lag in zip(command, lags, strict=True)))

    def move(x, u):
        return rk4_step(lambda w: model(w, u), x, DT), x

    return jax.lax.scan(move, x0, acting)[1]


def pairs(trace):
    return samples(trace, trace.command)


def lap(x: State, u: Control, alive, drifting) -> Trace:
    num = len(alive)
    zero: Any = np.zeros(num)
    sensed = Sensed(x.V, x.beta, x.r, zero, zero, zero, jnp.asarray(np.arange(float(num))), zero, zero)
    decision = Decision(
        u, jnp.asarray(drifting), jnp.asarray(np.ones(num, bool)), zero, jnp.asarray(np.zeros(num, int))
    )
    return Trace(jnp.asarray(alive), sensed, *x, zero, zero, zero, zero, zero, u.delta, u.Fxr, u, decision)


@pytest.mark.parametrize("dt", [0.01, 0.05])
def test_a_planted_constant_rate_comes_back(dt):
    model = Corrected(NOMINAL, lambda z: jnp.asarray(PLANTED))
    step = eqx.filter_jit(lambda rates: rk4_step(rates, X0, dt))
    after = step(lambda w: model(w, U0))
    rate = residual_rate(NOMINAL, X0, U0, after, jnp.asarray(dt))
    # three fixed-point sweeps leave an error of order (dt times the rates of the model) cubed
    np.testing.assert_allclose(rate, PLANTED, atol=2e-3 if dt > 0.02 else 2e-5)
    again = step(lambda w: jax.tree.map(jnp.add, NOMINAL(w, U0), State(*np.asarray(rate))))
    np.testing.assert_allclose(again, after, rtol=1e-4)


def test_the_nominal_car_leaves_no_residual():
    after = jax.jit(lambda: rk4_step(lambda w: NOMINAL(w, U0), X0, DT))()
    np.testing.assert_allclose(residual_rate(NOMINAL, X0, U0, after, jnp.asarray(DT)), np.zeros(3), atol=1e-12)


def test_smoothing_keeps_parabolas_and_delays_nothing():
    t = np.arange(20.0)
    parabola = 0.3 * t**2 - 2 * t + 1
    np.testing.assert_allclose(smooth(jnp.asarray(parabola)), parabola, atol=1e-11)
    spike = np.zeros(11)
    spike[5] = 1.0
    response = np.asarray(smooth(jnp.asarray(spike)))
    np.testing.assert_allclose(response, response[::-1], atol=1e-15)
    assert response[5] == pytest.approx(17 / 35) and response.sum() == pytest.approx(1.0)


def test_rows_hold_the_planted_rate_where_the_car_drifted_and_zeros_elsewhere():
    x, u = driven()
    alive = np.arange(T) < 22
    drifting = (np.arange(T) >= 8) & (np.arange(T) != 15)
    Z, Y, mask = (np.asarray(a) for a in rows(NOMINAL, pairs(lap(x, u, alive, drifting)), jnp.asarray(DT), NONE))
    assert Z.shape == (T - 1, 5) and Y.shape == (T - 1, 3)
    k = np.arange(T - 1)
    # both ends of a row need two living neighbours either side
    expected = drifting[:-1] & (k >= 2) & (k + 1 + 2 <= 21)
    np.testing.assert_array_equal(mask, expected)
    assert np.all(Z[~mask] == 0) and np.all(Y[~mask] == 0)
    np.testing.assert_allclose(Y[mask], np.tile(PLANTED, (mask.sum(), 1)), atol=0.02)
    np.testing.assert_allclose(Z[mask][:, 3], np.asarray(u.delta)[:-1][mask])
    np.testing.assert_allclose(Z[mask][:, 4], np.asarray(u.Fxr)[:-1][mask])
    np.testing.assert_allclose(Z[mask][:, 0], np.asarray(x.V)[:-1][mask], atol=1e-3)


def test_rows_too_near_the_start_or_the_end_are_no_data():
    x, u = driven()
    everywhere = np.ones(T, bool)
    k = np.arange(T - 1)
    _, _, mask = rows(NOMINAL, pairs(lap(x, u, everywhere, everywhere)), jnp.asarray(DT), NONE)
    np.testing.assert_array_equal(mask, (k >= 2) & (k <= T - 4))


def test_a_sample_that_is_not_a_number_is_no_data():
    x, u = driven()
    broken = x._replace(r=jnp.asarray(np.where(np.arange(T) == 20, np.nan, x.r)))
    everywhere = np.ones(T, bool)
    Z, Y, mask = rows(NOMINAL, pairs(lap(broken, u, everywhere, everywhere)), jnp.asarray(DT), NONE)
    assert np.all(np.isfinite(Z)) and np.all(np.isfinite(Y))
    assert not bool(mask[20]) and bool(mask[10])


def test_what_a_lag_has_reached_is_the_exact_mean_of_its_response():
    command, lag = jnp.asarray([0.0, 1.0, 1.0, -0.5]), 0.08
    fine, value, mean = 20000, 0.0, []
    for target in np.asarray(command):
        left = np.exp(-DT / fine / lag)
        path = target + (value - target) * left ** np.arange(fine + 1)
        mean.append(np.trapezoid(path) / fine)
        value = path[-1]
    np.testing.assert_allclose(lagged_input(command, jnp.asarray(lag), jnp.asarray(DT)), mean, atol=1e-9)
    np.testing.assert_array_equal(lagged_input(command, jnp.asarray(0.0), jnp.asarray(DT)), command)
    slope = jax.jit(jax.grad(lambda tau: jnp.sum(lagged_input(command, tau, jnp.asarray(DT)))))(jnp.asarray(0.0))
    assert np.isfinite(slope)


def test_nothing_is_reached_before_the_first_command():
    command, lag, dt = jnp.asarray([1.0, 1.0, 0.5]), jnp.asarray(0.08), jnp.asarray(DT)
    left = np.exp(-DT / 0.08)
    at, mean = lag_response(command, lag, dt)
    np.testing.assert_allclose(at, [0.0, 1 - left, 1 - left**2])  # as the driver's memory, which starts from 0
    np.testing.assert_allclose(mean[0], 1 - (1 - left) * 0.08 / DT)
    np.testing.assert_array_equal(lagged_input(command, lag, dt), mean)


@pytest.mark.parametrize("lags", [(0.0, 0.0), (0.05, 0.1), (0.1, 0.05)])
def test_hidden_lags_are_found(lags):
    num, rng = 140, np.random.default_rng(1)
    held = np.repeat(rng.normal(size=(num // 4, 2)), 4, axis=0)  # a new command every four steps, in gripping driving
    command = Control(jnp.asarray(0.02 * held[:, 0]), jnp.asarray(1500.0 * held[:, 1]))
    x, _ = driven(State(*(jnp.asarray(v) for v in (18.0, 0.0, 0.0))), command, lags)
    noisy = State(*(a + s * rng.normal(size=num) for a, s in zip(x, (0.02, 0.002, 0.002), strict=True)))
    everywhere = np.ones(num, bool)
    estimate = estimate_lags(NOMINAL, pairs(lap(noisy, command, everywhere, everywhere)), jnp.asarray(DT))
    np.testing.assert_allclose(estimate, lags, atol=0.026)  # one step of the grid
