"""Drives a manoeuvre on a universal car and records what a measurement would: the source of logs with a known truth.

The plant runs at its own small step with another integrator than the model that later explains the log, its rates are
disturbed, and the driver only sees noisy measurements.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.sim.rollout import SETTLE
from driftjax.sim.step import settled
from driftjax.sim.travel import Travel, recall, told, travel
from driftjax.vehicle.effect.flow import Aux, Place, initial_flow
from driftjax.vehicle.parameters import VehicleConfig
from driftjax.vehicle.universal import Universal

FILTER = 0.1  # time constant of the driver's filter on what is measured, over sqrt(L / g) [-]


class Manoeuvre(NamedTuple):
    """What a driver does: states aimed at, commands that go with them, and a feedback on the difference."""

    x_ref: Float[Array, "T 3"]  # V, beta, r
    u_ref: Float[Array, "T 2"]  # delta [rad], Fxr [N]
    K: Float[Array, "2 3"]  # command less per unit of the state's excess
    lap: Array  # length of one lap, for the position along it [m]


class Conditions(NamedTuple):
    """What disturbs the car and its measurement."""

    sigma: Float[Array, "3"]  # standard deviation of measured V, beta, r
    disturbance: Float[Array, "3"]  # standard deviation of rates added to those of V, beta, r
    correlation: Array  # correlation time of these [s]


class Recording(NamedTuple):
    """Rows of a log (T,) and the truth behind them."""

    y: Float[Array, "T 3"]  # measured V, beta, r
    command: Float[Array, "T 2"]
    place: Place  # fields (T,); position along the lap as a share of it
    x: Float[Array, "T 3"]  # true V, beta, r
    position: Float[Array, "T 2"]  # true x, y [m]
    a: Float[Array, "T 2"]  # what an accelerometer at the centre of mass felt forwards and to the left [m/s^2]: the
    # mean since the last row, as its filter against aliasing makes it


class _Now(NamedTuple):
    car: Travel
    seen: Array  # filtered measurement
    command: Array
    push: Array
    a: Array


def specific_force(plant: Universal, x: State, dx: State, u: Control, place: Place) -> Float[Array, "2"]:
    """What an accelerometer at the centre of mass feels of a motion with rates `dx`, forwards and to the left [m/s^2].

    That is the acceleration less the part of gravity along a road that is not level: the effects of the road, which are
    those of the forces that show in kinematic parity.
    """
    sin, cos, turn = jnp.sin(x.beta), jnp.cos(x.beta), x.V * (dx.beta + x.r)
    level = initial_flow(plant.car, x, u, place, Aux(jnp.zeros(2), jnp.zeros(())))
    road, values = level, plant.values()
    for effect in plant.effects:
        if effect.station == "force" and effect.kinematic:
            road = effect.apply(road, values[effect.name])
    return jnp.stack([
        dx.V * cos - turn * sin - (road.X - level.X) / level.car.m,
        dx.V * sin + turn * cos - (road.Y - level.Y) / level.car.m,
    ])  # fmt: skip


def record(
    plant: Universal, vehicle: VehicleConfig, manoeuvre: Manoeuvre, conditions: Conditions, key: Array, dt: float,
    substeps: int = 10,
) -> Recording:  # fmt: skip
    """One run of `manoeuvre` at sample time `dt` [s], the plant `substeps` times as fast; starts on its first row."""
    h = dt / substeps
    lower, upper, rate = vehicle.command_limits()
    nominal = vehicle.build()
    smooth = 1 - jnp.exp(-dt / (FILTER * plant.base.unit_time))
    first = State(*manoeuvre.x_ref[0])
    u0 = jnp.clip(manoeuvre.u_ref[0], lower, upper)

    def warm(memory, _):
        return plant.apply_actuators(memory, Control(u0[0], u0[1]), first.V, h)

    memory, held = jax.lax.scan(warm, plant.start(h), length=round(SETTLE / h))
    zero, reached = jnp.zeros(()), jax.tree.map(lambda a: a[-1], held)
    place, still = Place(zero, zero, zero, zero), State(zero, zero, zero)
    felt, past = settled(plant, first, reached, place), recall(plant, first, h)
    car = Travel(first, felt, memory, place, jnp.zeros(2), zero, still, reached, past, jnp.asarray(h))
    start = _Now(car, manoeuvre.x_ref[0], u0, jnp.zeros(3), specific_force(plant, first, still, reached, place))

    def step(now: _Now, row):
        x_ref, u_ref, noise, kick = row
        car = now.car
        y = jnp.stack(told(plant, car)) + noise
        seen = now.seen + smooth * (y - now.seen)
        command = jnp.clip(u_ref - manoeuvre.K @ (seen - x_ref), now.command - dt * rate, now.command + dt * rate)
        command = jnp.clip(command, lower, upper)
        left = jnp.exp(-dt / conditions.correlation)
        push = left * now.push + jnp.sqrt(1 - left**2) * kick
        row = Recording(y, command, car.place, jnp.stack(car.x), car.position, now.a)
        u = Control(command[0], command[1])

        def fine(_, carry):
            car, a = carry
            car = travel(plant, nominal, manoeuvre.lap, car, u, jnp.asarray(h), State(*push))
            return car, a + specific_force(plant, car.x, car.rate, u, car.place) / substeps

        car, a = jax.lax.fori_loop(0, substeps, fine, (car, jnp.zeros(2)))
        return _Now(car, seen, command, push, a), row

    T = len(manoeuvre.x_ref)
    measured, driven = jax.random.split(key)
    noise = conditions.sigma * jax.random.normal(measured, (T, 3))
    kicks = conditions.disturbance * jax.random.normal(driven, (T, 3))
    start = start._replace(push=kicks[0])
    return jax.lax.scan(step, start, (manoeuvre.x_ref, manoeuvre.u_ref, noise, kicks))[1]
