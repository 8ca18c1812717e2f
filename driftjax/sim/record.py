"""Drive a manoeuvre with a universal car and record the measurements: a source of logs with a known truth.

The plant is integrated at its own small step by another integrator than the model that later explains the log, its
rates are disturbed, and the driver uses noisy measurements only.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from driftjax.core import Control, State, markov_step
from driftjax.sim.rollout import SETTLE
from driftjax.sim.step import steady_lagged_state
from driftjax.sim.travel import Travel, delay_buffer, sensor_reading, travel
from driftjax.vehicle.effect.flow import Aux, Place, initial_flow
from driftjax.vehicle.parameters import VehicleConfig
from driftjax.vehicle.universal import Universal

FILTER = 0.1  # time constant of the driver's measurement filter, relative to sqrt(L / g) [-]


class Manoeuvre(NamedTuple):
    """Reference states and commands of a driver, and the feedback gain on the tracking error."""

    x_ref: Float[Array, "T 3"]  # V, beta, r
    u_ref: Float[Array, "T 2"]  # delta [rad], Fxr [N]
    K: Float[Array, "2 3"]  # command change per unit of state error, subtracted
    lap: Array  # length of one lap, for the position along it [m]


class Conditions(NamedTuple):
    """Disturbances of the car and of its measurements."""

    sigma: Float[Array, "3"]  # standard deviation of the white errors of measured V, beta, r
    disturbance: Float[Array, "3"]  # standard deviation of the rates added to those of V, beta, r
    correlation: Array  # correlation time of these [s]
    slow: Float[Array, "3"]  # standard deviation of the slow errors of measured V, beta, r
    slow_correlation: Array  # correlation time of these [s]


class Recording(NamedTuple):
    """Rows of a log (T,) and the true values behind them."""

    y: Float[Array, "T 3"]  # measured V, beta, r
    command: Float[Array, "T 2"]
    place: Place  # fields (T,); position along the lap as a fraction of it
    x: Float[Array, "T 3"]  # true V, beta, r
    position: Float[Array, "T 2"]  # true x, y [m]
    a: Float[Array, "T 2"]  # accelerometer at the centre of mass, forwards and to the left [m/s^2]: mean since the
    # last row, as after its anti-aliasing filter


def markov_noise(key: Array, num: int, sigma: Array, correlation: Array, dt: float) -> Float[Array, "num 3"]:
    """Draw stationary first-order Markov noise of this standard deviation and correlation time [s]."""
    left = jnp.exp(-dt / correlation)
    white = sigma * jax.random.normal(key, (num, 3))

    def on(last, kick):
        now = markov_step(last, kick, left)
        return now, now

    return jnp.concatenate([white[:1], jax.lax.scan(on, white[0], white[1:])[1]])


class _Now(NamedTuple):
    car: Travel
    filtered: Array  # filtered measurement
    command: Array
    push: Array
    a: Array


def road_acceleration(plant: Universal, x: State, u: Control, place: Place) -> tuple[Array, Array]:
    """Return the acceleration by gravity on a sloped or banked road, forwards and to the left [m/s^2].

    The road effects are those force effects that appear in kinematic parity.
    """
    level = initial_flow(plant.car, x, u, place, Aux(jnp.zeros(2), jnp.zeros(())))
    road, values = level, plant.values()
    for effect in plant.effects:
        if effect.station == "force" and effect.kinematic:
            road = effect.apply(road, values[effect.name])
    return (road.X - level.X) / level.car.m, (road.Y - level.Y) / level.car.m


def specific_force(plant: Universal, x: State, dx: State, u: Control, place: Place) -> Float[Array, "2"]:
    """Return the specific force at the centre of mass, forwards and to the left [m/s^2], for the rates `dx`.

    It is the acceleration minus the component of gravity along a road that is not level.
    """
    sin, cos, turn = jnp.sin(x.beta), jnp.cos(x.beta), x.V * (dx.beta + x.r)
    along, left = road_acceleration(plant, x, u, place)
    return jnp.stack([dx.V * cos - turn * sin - along, dx.V * sin + turn * cos - left])


def _settled_start(plant: Universal, manoeuvre: Manoeuvre, lower: ArrayLike, upper: ArrayLike, h: float) -> _Now:
    """Return the car in the first state of `manoeuvre`, its actuators settled at the first command, within limits."""
    first = State(*manoeuvre.x_ref[0])
    u0 = jnp.clip(manoeuvre.u_ref[0], lower, upper)

    def settle(memory, _):
        return plant.apply_actuators(memory, Control(u0[0], u0[1]), first.V, h)

    memory, inputs = jax.lax.scan(settle, plant.start(h), length=round(SETTLE / h))
    zero, acting = jnp.zeros(()), jax.tree.map(lambda a: a[-1], inputs)
    place, still = Place(zero, zero, zero, zero), State(zero, zero, zero)
    lagged, past = steady_lagged_state(plant, first, acting, place), delay_buffer(plant, first, h)
    car = Travel(first, lagged, memory, place, jnp.zeros(2), zero, still, acting, past, jnp.asarray(h))
    return _Now(car, manoeuvre.x_ref[0], u0, jnp.zeros(3), specific_force(plant, first, still, acting, place))


def record(
    plant: Universal, vehicle: VehicleConfig, manoeuvre: Manoeuvre, conditions: Conditions, key: Array, dt: float,
    substeps: int = 10,
) -> Recording:  # fmt: skip
    """Record one run of `manoeuvre` at sample time `dt` [s] with `substeps` plant steps per sample."""
    h = dt / substeps
    lower, upper, rate = vehicle.command_limits()
    nominal = vehicle.build()
    smooth = 1 - jnp.exp(-dt / (FILTER * plant.base.unit_time))
    start = _settled_start(plant, manoeuvre, lower, upper, h)

    def step(now: _Now, row):
        x_ref, u_ref, noise, kick = row
        car = now.car
        y = jnp.stack(sensor_reading(plant, car)) + noise
        filtered = now.filtered + smooth * (y - now.filtered)
        command = jnp.clip(u_ref - manoeuvre.K @ (filtered - x_ref), now.command - dt * rate, now.command + dt * rate)
        command = jnp.clip(command, lower, upper)
        left = jnp.exp(-dt / conditions.correlation)
        push = markov_step(now.push, kick, left)
        row = Recording(y, command, car.place, jnp.stack(car.x), car.position, now.a)
        u = Control(command[0], command[1])

        def fine(_, carry):
            car, a = carry
            car = travel(plant, nominal, manoeuvre.lap, car, u, jnp.asarray(h), State(*push))
            return car, a + specific_force(plant, car.x, car.rate, u, car.place) / substeps

        car, a = jax.lax.fori_loop(0, substeps, fine, (car, jnp.zeros(2)))
        return _Now(car, filtered, command, push, a), row

    T = len(manoeuvre.x_ref)
    measured, driven = jax.random.split(key)
    noise = conditions.sigma * jax.random.normal(measured, (T, 3))
    noise += markov_noise(jax.random.fold_in(key, 2), T, conditions.slow, conditions.slow_correlation, dt)
    kicks = conditions.disturbance * jax.random.normal(driven, (T, 3))
    start = start._replace(push=kicks[0])
    return jax.lax.scan(step, start, (manoeuvre.x_ref, manoeuvre.u_ref, noise, kicks))[1]
