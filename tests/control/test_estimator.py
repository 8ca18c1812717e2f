"""The estimator in closed loop: exact where the model is, as sure as its errors are, and ahead by the delay."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.estimator import build_estimator
from driftjax.core import Control, State, lag_step, rk4_step
from driftjax.gp import zero_gp
from driftjax.sim.lap import sensed_on, wrap
from driftjax.track.build import from_curvature
from driftjax.vehicle import build_car, load_vehicle, no_residual

DT = 0.05
VEHICLE = load_vehicle("sedan")
CAR = build_car(VEHICLE)
LAGS = {"at once": (0.0, 0.0), "lagging": (0.05, 0.08)}
NOISE = jnp.array([0.02, 0.003, 0.01, 0.05, 0.05, 0.01])
COMMANDS = np.column_stack([0.1 * np.sin(0.4 * np.arange(40)), 1500.0 + 500.0 * np.cos(0.3 * np.arange(40))])


def estimator(delay):
    size = VEHICLE.m * 9.81, VEHICLE.a, VEHICLE.Iz
    return build_estimator(NOISE, delay, DT, 12.0, *size)


def residual(lags):
    return no_residual(zero_gp(4, 5, 3), jnp.array(LAGS[lags]))


def drive(delay, lags, fine):
    """Motion at every `fine` step and actuator outputs, of the model itself, commands acting after `delay`."""
    late, per = round(delay / fine), round(DT / fine)

    def step(x, lagged, u):
        acting, end = lag_step(lagged, u, jnp.array(LAGS[lags]), jnp.asarray(fine))

        def rates(w):
            dx = CAR(State(w[0], w[1], w[2]), Control(acting[0], acting[1]))
            course = w[5] + w[1]
            return jnp.stack([*dx, w[0] * jnp.cos(course), w[0] * jnp.sin(course), w[2]])

        return rk4_step(rates, x, jnp.asarray(fine)), end

    step, x, lagged, rows = eqx.filter_jit(step), jnp.array([12.0, 0.0, 0.0, 0.0, 0.0, 0.0]), jnp.zeros(2), []
    for i in range(per * len(COMMANDS)):
        rows.append((x, lagged))
        k = (i - late) // per
        x, lagged = step(x, lagged, jnp.asarray(COMMANDS[k] if i >= late else np.zeros(2)))
    return (np.array(column) for column in zip(*rows, strict=True))


@eqx.filter_jit
def follow(filter_, motion, commands, d):
    def on(estimate, row):
        y, u = row
        now = filter_.update(estimate, y)
        return filter_.predict(CAR, d, now, u), (now, filter_.ahead(CAR, d, now))

    return jax.lax.scan(on, filter_.start(), (motion, commands))[1]


@pytest.mark.parametrize(
    ("delay", "lags", "fine"),
    [(0.0, "at once", DT), (0.05, "at once", DT), (0.1, "lagging", DT), (0.04, "lagging", 0.01)],
)
def test_the_prediction_is_where_the_car_will_be_when_the_command_acts(delay, lags, fine):
    motion, outputs = drive(delay, lags, fine)
    per, late = round(DT / fine), round(delay / fine)
    now, (x, reached) = follow(estimator(delay), jnp.asarray(motion[::per]), jnp.asarray(COMMANDS), residual(lags))
    num = len(motion[late::per])
    np.testing.assert_allclose(reached[:num], outputs[late::per], rtol=1e-9, atol=1e-9)
    # a lagging input is replaced by its mean over a step: in the last case steps of 50 instead of 10 ms differ
    atol = 1e-9 if fine == DT else 0.02
    np.testing.assert_allclose(now.x, motion[::per], atol=atol)
    np.testing.assert_allclose(x[:num], motion[late::per], atol=atol)


def test_noisy_measurements_give_errors_of_the_stated_size_and_smaller_ones():
    truth, _ = drive(0.0, "at once", DT)
    filter_ = dataclasses.replace(estimator(0.0), rate_noise=jnp.zeros(6))
    noise = np.random.default_rng(0).normal(size=(60, *truth.shape)) * np.asarray(NOISE)
    each = lambda y: follow(filter_, y, jnp.asarray(COMMANDS), residual("at once"))
    now, _ = jax.vmap(each)(jnp.asarray(truth + noise))
    error = np.asarray(now.x)[:, 5:] - truth[5:]
    size = np.sqrt(np.mean(error**2, axis=(0, 1)))
    stated = np.sqrt(np.mean(np.diagonal(np.asarray(now.P)[:, 5:], axis1=2, axis2=3), axis=(0, 1)))
    assert np.all(size < 0.5 * np.asarray(NOISE))
    np.testing.assert_allclose(size, stated, rtol=0.25)
    assert np.all(np.linalg.eigvalsh(np.asarray(now.P)) > -1e-16)


def test_a_heading_that_is_a_turn_ahead_is_the_same_heading():
    filter_ = estimator(0.0)
    first = filter_.update(filter_.start(), jnp.array([12.0, 0.0, 0.0, 0.0, 0.0, 3.1]))
    near = filter_.update(first, jnp.array([12.0, 0.0, 0.0, 0.0, 0.0, -3.1]))
    assert abs(float(wrap(near.x[5] - jnp.pi))) < 0.05


def test_the_estimate_has_its_place_on_the_path():
    path = from_curvature([0.0, 40.0], [0.0, 0.0], 3.0, 161)
    sensed = sensed_on(path, jnp.asarray(7.0), *jnp.array([10.0, -0.1, 0.2, 7.5, 0.4, 0.1]))
    assert float(sensed.s) == pytest.approx(7.5) and float(sensed.e) == pytest.approx(0.4)
    assert float(sensed.theta) == pytest.approx(0.1) and float(sensed.beta) == -0.1
