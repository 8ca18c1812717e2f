"""Steps of the universal car: the nominal one without effects, lags by hand, and derivatives by another route."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from driftjax.core import Control, State, rk4_step
from driftjax.sim.rollout import SETTLE, actuator_response, begin, move, sensor_reading
from driftjax.sim.sensitivity import move_with_derivatives
from driftjax.sim.step import LaggedState, constant_hold, lagged_step, steady_lagged_state
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import Place, effects_by_name
from driftjax.vehicle.effect.flow import Aux
from driftjax.vehicle.universal import Universal, universal_car

NUM, DT = 12, 0.01
BENT = (  # every lag, and effects of every station that a step runs through
    "friction_rear sliding_friction load_sensitivity load_transfer_long combined_slip relaxation_length mass cog_shift "
    "roll_lag roll_steer side_wind drive_split"
).split()
PUSH = jnp.array([0.3, -0.1, 0.4])  # on the rates
STILL = Place(*map(jnp.asarray, (0.0, 0.0, 0.0, 0.0)))


def car_with(car="sedan", **values_of) -> Universal:
    """The car with these effects of one parameter each, SI."""
    model = universal_car(load_vehicle(car), effects_by_name(tuple(values_of)))
    values = jnp.array([float(values_of[effect.name]) for effect in model.effects])
    return model.with_parameters(values / model.scale)


def without_grip(model: Universal) -> Universal:
    """The car on ice so smooth that nothing pushes it: it goes on straight."""
    base = model.base._replace(muf=jnp.asarray(1e-13), mur=jnp.asarray(1e-13))
    return Universal(base, model.effects, model.scale, model.theta)


@functools.cache
def rich():
    """States with lagged states (NUM, 6), commands and places: sliding and gripping, driven and braked."""
    rng, vehicle = np.random.default_rng(5), load_vehicle("sedan")
    between = lambda low, high: rng.uniform(low, high, NUM)
    x = [between(5, 20), between(-0.6, 0.6), between(-1.0, 1.0)]
    lagged = [between(-0.4, 0.4), between(-0.4, 0.4), between(-8, 8)]
    u = [between(-0.4, 0.4), vehicle.Fxr_max * between(-0.5, 0.8), np.zeros(NUM), np.zeros(NUM)]
    place = Place(*map(jnp.asarray, (between(0, 60), between(-3, 3), between(0, 1), between(0, 0.3))))
    return jnp.asarray(np.stack(x + lagged, axis=1)), jnp.asarray(np.stack(u, axis=1)), place


@functools.cache
def bent(substeps: int = 1) -> Universal:
    """The sedan with many effects at once, lags included, at sizes met in practice."""
    model = universal_car(load_vehicle("sedan"), effects_by_name(tuple(BENT)), substeps)
    lower = np.array([parameter.lower for effect in model.effects for parameter in effect.parameters])
    rng = np.random.default_rng(6)
    sign = np.where(lower == 0, 1.0, rng.choice([-1.0, 1.0], len(lower)))
    return model.with_parameters(jnp.asarray(sign * rng.uniform(0.4, 1.2, len(lower))))


@pytest.mark.parametrize("combined_slip", [0.0, 1.0])
def test_a_step_without_effects_is_one_of_the_nominal_car(combined_slip):
    vehicle = replace(load_vehicle("sedan"), combined_slip=combined_slip)
    model, nominal = bent().with_parameters(jnp.zeros_like(bent().theta)), vehicle.build()
    base = universal_car(vehicle, ()).base
    model = Universal(base, model.effects, model.scale, model.theta)
    z, u, place = rich()
    after = jax.jit(jax.vmap(lambda z, u, place: move(model, z, u, place, jnp.asarray(DT)).z))(z, u, place)

    def one(z, u):
        control = Control(u[0], u[1])
        x = rk4_step(lambda x: nominal(x, control), State(z[0], z[1], z[2]), DT)
        return jnp.stack([*x, *nominal.slip_angles(x, control)])

    expected = jax.jit(jax.vmap(one))(z, u)
    np.testing.assert_allclose(after[:, :5], expected, rtol=1e-12, atol=1e-13)  # tyres feel the slip there is


def steered(model, delta, num, V=10.0, beta=0.1, r=0.0, place=STILL, dt=DT):
    """State and lagged state (num + 1, 6) after the steering jumps from 0 to `delta`."""
    z0 = begin(model, jnp.array([V, beta, r]), jnp.zeros(4), place)
    on = lambda z, _: (lambda z: (z, z))(move(model, z, jnp.array([delta, 0.0, 0.0, 0.0]), place, jnp.asarray(dt)).z)
    return np.concatenate([z0[None], jax.jit(lambda z: jax.lax.scan(on, z, length=num)[1])(z0)])


@pytest.mark.parametrize("dt", [0.002, 0.05])
def test_slip_settles_over_the_relaxation_length(dt):
    sigma, V, beta, delta, num = 0.6, 10.0, 0.1, 0.2, 30
    states = steered(without_grip(car_with(relaxation_length=sigma)), delta, num, V, beta, dt=dt)
    np.testing.assert_allclose(states[:, :3], np.tile([V, beta, 0.0], (num + 1, 1)), atol=1e-11)
    away = np.exp(-V * dt * np.arange(1, num + 1) / sigma)
    np.testing.assert_allclose(states[0, 3:5], beta, atol=1e-11)
    np.testing.assert_allclose(states[1:, 3], beta - delta + delta * away, atol=1e-11)
    np.testing.assert_allclose(states[1:, 4], beta, atol=1e-11)


def test_slip_that_grows_evenly_lags_by_the_relaxation_time():
    sigma, V, r, dt, num = 0.4, 10.0, 0.02, 0.02, 40  # turning on the spot without grip: slip grows at about r
    model = without_grip(car_with(relaxation_length=sigma))
    start = begin(model, jnp.array([V, 0.0, r]), jnp.zeros(4), STILL)
    on = lambda z, _: (lambda z: (z, z))(move(model, z, jnp.zeros(4), STILL, jnp.asarray(dt)).z)
    states = np.asarray(jax.lax.scan(on, start, length=num)[1])
    slip = np.stack([states[:, 1] + a * r / V for a in (1.4, -1.65)], axis=1)
    np.testing.assert_allclose(states[:, 3:5], slip + r * sigma / V, atol=2e-6)  # of 8e-4 by which it is late


def test_roll_follows_the_lateral_acceleration():
    tau, dt, num = 0.15, 0.01, 200
    model = car_with(roll_lag=tau)
    states = steered(model, 0.02, num, V=12.0, beta=0.0, dt=dt)
    nominal = load_vehicle("sedan").build()
    steady = nominal(State(*map(jnp.asarray, states[-1, :3])), Control(jnp.asarray(0.02), jnp.asarray(0.0)))
    np.testing.assert_allclose(states[-1, 5], states[-1, 0] * (states[-1, 2] + float(steady.beta)), rtol=0.01)
    first = float(states[1, 5] / (1 - np.exp(-dt / tau)))  # the acceleration that the jump of the front force gives
    side = nominal.tyre.lateral(jnp.asarray(-0.02), nominal.Fzf) / nominal.m
    np.testing.assert_allclose(first, side * np.cos(0.02), rtol=1e-6)


def test_the_lagged_state_forgets_its_start():
    model, (z, u, place) = bent(), rich()
    at = jax.tree.map(lambda a: a[0], place)
    x, control = State(z[0, 0], z[0, 1], z[0, 2]), Control(u[0, 0], u[0, 1])
    apart = [steady_lagged_state(model, x, control, at), LaggedState(z[1, 3:5], z[1, 5])]

    def on(lagged_states, _):
        states = [
            lagged_step(model, x, lagged, constant_hold(control), at, jnp.asarray(1e-4))[1] for lagged in lagged_states
        ]
        return states, None

    one, other = jax.lax.scan(on, apart, length=20000)[0]  # fixed state, moving lagged state: 2 s
    np.testing.assert_allclose(jnp.stack([*one.slip, one.ay]), jnp.stack([*other.slip, other.ay]), rtol=1e-4, atol=1e-6)


def test_steps_with_lags_converge():
    model = car_with(relaxation_length=0.5, roll_lag=0.12)
    ends = [steered(model, 0.08, num, V=15.0, dt=0.6 / num)[-1] for num in (30, 60, 120, 30 * 40)]
    scale = np.abs(ends[-1]) + np.array([0, 0.01, 0.01, 0.01, 0.01, 0.1])
    errors = [np.abs((end - ends[-1]) / scale).max() for end in ends[:-1]]
    assert errors[0] < 0.02
    assert errors[1] < 0.6 * errors[0] and errors[2] < 0.6 * errors[1]


@pytest.mark.parametrize("tau", [0.004, 0.07, 0.3])
def test_lagging_steering_is_that_of_the_differential_equation(tau):
    rng, num, lead = np.random.default_rng(2), 60, round(SETTLE / DT)
    jumps = np.zeros(lead + num)
    jumps[[0, lead, lead + 7, lead + 30]] = [0.1, *rng.uniform(-0.3, 0.3, 3)]
    commands = np.stack([np.cumsum(jumps), np.full(lead + num, 500.0)], axis=1)
    inputs = actuator_response(car_with(steer_lag=tau), jnp.asarray(commands), jnp.full(lead + num, 10.0), DT)
    k = np.arange(lead + num)  # mean over step k of the response 1 - exp(-t / tau) to a jump at its begin
    response = 1 - np.exp(-k * DT / tau) * (1 - np.exp(-DT / tau)) * tau / DT
    np.testing.assert_allclose(inputs[:, 0], np.convolve(jumps, response)[: lead + num], atol=1e-12)
    t = (np.arange(1000) + 0.5) / 1000  # share of a step
    reached = np.cumsum(jumps)[:, None] - np.exp(-t * DT / tau) * lagging_behind(jumps, tau)[:, None]
    slope = 3 * (reached * (2 * t - 1)).mean(axis=1)
    np.testing.assert_allclose(inputs[:, 2], slope, atol=(0.1 if tau < DT else 3e-4) * np.abs(slope).max())
    np.testing.assert_allclose(inputs[:, 1::2], np.tile([500.0, 0.0], (lead + num, 1)), atol=1e-10)


@pytest.mark.parametrize("effects", [{}, {"steer_lag": 0.07, "steer_delay": 0.03}], ids=("immediate", "late"))
def test_linear_commands_are_those_of_many_short_held_ones(effects):
    model, lead, num, fine = car_with(**effects), round(SETTLE / DT), 40, 32
    t = DT * np.arange(lead + num)
    command = lambda t: np.stack([np.interp(t, [1.0, 1.1, 1.3], [0.0, 0.3, -0.1]), 0 * t], axis=1)
    means, changes = (command(t) + command(t + DT)) / 2, command(t + DT) - command(t)
    V = lambda n: jnp.full(n, 10.0)
    inputs = actuator_response(model, jnp.asarray(means), V(len(t)), DT, jnp.asarray(changes))
    short = (np.arange(fine * len(t)) + 0.5) * DT / fine
    exact = actuator_response(model, jnp.asarray(command(short)), V(len(short)), DT / fine)[:, 0].reshape(-1, fine)
    where = (2 * np.arange(fine) + 1) / fine - 1
    tilt = (exact * where).mean(axis=1) / np.mean(where**2)
    size = np.abs(changes).max()
    np.testing.assert_allclose(inputs[lead:, 0], exact.mean(axis=1)[lead:], atol=0.01 * size)
    np.testing.assert_allclose(inputs[lead:, 2], tilt[lead:], atol=0.03 * size)
    if not effects:
        held = actuator_response(model, jnp.asarray(means), V(len(t)), DT)
        assert np.abs(held[lead:, 2] - tilt[lead:]).max() > 0.4 * size


def lagging_behind(jumps, tau):
    """Lag error of a first-order lag at the start of each step, after the jump there."""
    behind = [0.0]
    for jump in jumps:
        behind.append(behind[-1] * np.exp(-DT / tau) + jump)
    return np.array(behind[1:])


def test_actuators_have_forgotten_their_start_after_settling():
    model = car_with(steer_lag=0.14, steer_delay=0.1, drive_lag=0.16)
    lead = round(SETTLE / DT)
    rest = jnp.tile(jnp.array([[0.3, 2000.0]]), (lead + 2, 1))
    response = actuator_response(model, rest, jnp.full(lead + 2, 10.0), DT)
    np.testing.assert_allclose(response[lead:, :2], rest[lead:], rtol=3e-3)


def test_sensors_tell_the_yaw_rate_with_its_bias():
    model = car_with(gyro_bias=0.03)
    reading = sensor_reading(model, jnp.array([10.0, -0.3, 0.5]), jnp.ones((3, 3)), jnp.asarray(DT))
    np.testing.assert_allclose(reading, [10.0, -0.3, 0.53], rtol=1e-14)


@pytest.mark.parametrize("steps", [0.0, 0.3, 0.999, 1.0, 2.6])
def test_what_is_late_is_reported_as_it_was(steps):
    """Less whole steps, and exactly where the state moves along a cubic."""
    model = universal_car(load_vehicle("sedan"), effects_by_name(("channel_delay",)))
    model = model.with_parameters(jnp.array([0.0, steps, 0.4 * steps]) * DT / model.scale)
    cubics = [np.polynomial.Polynomial(c) for c in np.random.default_rng(8).normal(size=(3, 4)) + [[10], [0], [0]]]
    x = np.array([p(0.0) for p in cubics])
    rates = np.stack([[(p(0.0) - p(-DT)) / DT, p.deriv()(-DT), p.deriv()(0.0)] for p in cubics], axis=1)
    reading = sensor_reading(model, jnp.asarray(x), jnp.asarray(rates), jnp.asarray(DT))
    rest = np.mod([0.0, steps, 0.4 * steps], 1.0)
    np.testing.assert_allclose(reading, [p(-q * DT) for p, q in zip(cubics, rest, strict=True)], atol=1e-12)
    np.testing.assert_array_equal(model.split_delays(DT)[0], np.floor([0.0, steps, 0.4 * steps]))


@pytest.mark.slow  # each compiles for 25 s; tests/diagnosis/test_observer.py compares with differences
@pytest.mark.parametrize("substeps", [1, 3])
def test_derivatives_of_a_step_are_those_of_forward_mode(substeps):
    model, (z, u, place) = bent(substeps), rich()
    u = u.at[:, 2:].set(u[:, :2] / 5)
    assert float(model.car.relaxation) > 0.1 and float(model.car.roll_lag) > 0.05

    def both(z, u, place):
        def f(z, u, push, theta):
            return move(model.with_parameters(theta), z, u, place, jnp.asarray(DT), State(*push)).z

        by = jnp.concatenate(jax.jacfwd(f, (0, 1, 2, 3))(z, u, PUSH, model.theta), axis=1)
        return f(z, u, PUSH, model.theta), by, move_with_derivatives(model, z, u, place, jnp.asarray(DT), PUSH)

    value, exact, derivatives = jax.jit(jax.vmap(both))(z, u, place)
    np.testing.assert_allclose(derivatives.value, value, rtol=1e-12, atol=1e-13)
    largest = np.abs(exact).max(axis=0)  # (6, 13 + K)
    assert (largest.max(axis=0) > 0).all()  # a column of zeros would tell nothing
    largest = np.where(largest > 0, largest, 1.0)
    np.testing.assert_allclose(derivatives.by / largest, exact / largest, atol=1e-10)


@functools.cache
def late_tyres(dt):
    """A car whose tyres need 0.04 m, steered at random from straight on at 2.5 m/s; states (n, 5) every 10 ms."""
    model, delta = car_with("rc", relaxation_length=0.04), np.random.default_rng(4).normal(0.0, 0.08, 60)
    num = round(DT / dt)
    z0 = begin(model, jnp.array([2.5, 0.0, 0.0]), jnp.zeros(4), STILL)
    one = lambda z, d: jax.lax.fori_loop(
        0, num, lambda _, z: move(model, z, jnp.zeros(4).at[0].set(d).at[1].set(1.0), STILL, jnp.asarray(dt)).z, z
    )
    return delta, np.asarray(jax.jit(lambda z: jax.lax.scan(lambda z, d: (one(z, d),) * 2, z, delta)[1])(z0))[:, :5]


def test_late_tyres_are_those_of_the_differential_equation():
    """tau alpha_lag' + alpha_lag = alpha with the motion caused by the lagged slip (SciPy), to second order."""
    model = car_with("rc", relaxation_length=0.04)

    @jax.jit
    def rates(y, delta):
        x, u = State(y[0], y[1], y[2]), Control(delta, jnp.asarray(1.0))
        alpha = jnp.stack(model.car.nominal.slip_angles(x, u))
        dx = model.rates(x, u, STILL, Aux(y[3:] - alpha, jnp.zeros(())))
        return jnp.concatenate([jnp.stack(dx), (alpha - y[3:]) * x.V / model.car.relaxation])

    y, true = np.array([2.5, 0.0, 0.0, 0.0, 0.0]), []
    for delta in late_tyres(DT)[0]:
        y = solve_ivp(lambda _, y: rates(y, delta), (0, DT), y, rtol=1e-9, atol=1e-11).y[:, -1]  # noqa: B023
        true.append(y)
    size = np.ptp(true, axis=0)
    errors = [np.abs((late_tyres(dt)[1] - true) / size).max() for dt in (DT, DT / 4, DT / 16)]
    assert errors[0] < 0.04 and errors[1] < errors[0] / 16 and errors[2] < errors[1] / 10, errors
