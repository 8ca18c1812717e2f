"""Roll-outs of the universal car under given commands: what its actuators reach, how it moves, what sensors tell."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State, lag_step, rk4_step
from driftjax.core.integrate import axpy, repeated
from driftjax.vehicle.effect.flow import Aux, Place, rates
from driftjax.vehicle.universal import Universal

SETTLE = 1.0  # time after which actuators have forgotten where they began [s]
SLOWEST = 0.1  # speed below which the relaxation of the slip angles gets no slower [m/s]


class Felt(NamedTuple):
    """What follows the state with a lag, carried from step to step."""

    slip: Float[Array, "2"]  # slip angles of front and rear as the tyres feel them [rad]
    ay: Array  # lateral acceleration that roll has reached [m/s^2]


class Targets(NamedTuple):
    """What `Felt` follows, at one instant."""

    slip: Float[Array, "2"]
    slip_rate: Float[Array, "2"]
    ay: Array
    time: Array  # of the relaxation [s]


def acting(model: Universal, commands: Float[Array, "w 2"], V: Float[Array, " w"], dt: float) -> Float[Array, "w 2"]:
    """What steering [rad] and drive [N] make of commands held for one step each, from rest.

    Lags and delays forget: give `SETTLE` of commands before those of interest.
    """

    def move(memory, row):
        command, speed = row
        memory, u = model.act(memory, Control(command[0], command[1]), speed, dt)
        return memory, jnp.stack(u)

    return jax.lax.scan(move, model.start(dt), (commands, V))[1]


def motion(model: Universal, x: State, u: Control, place: Place, aux: Aux) -> tuple[State, Array]:
    """Rates of the state, and the lateral acceleration."""
    # without the barrier XLA works out each stage of a Runge-Kutta step anew for every entry of the next
    x, aux = jax.lax.optimization_barrier((x, aux))
    flow = model.flow(x, u, place, aux)
    return jax.lax.optimization_barrier((rates(flow), flow.ay))


def slip_of(model: Universal, x: State, u: Control) -> Float[Array, "2"]:
    """Geometric slip angles of front and rear [rad]."""
    return jnp.stack(model.car.nominal.slip_angles(x, u))


def time_of(model: Universal, x: State) -> Array:
    """Time of the relaxation at this speed [s]."""
    return model.car.relaxation / jnp.maximum(x.V, SLOWEST)


def late(model: Universal, x: State, dt: Array) -> Array:
    """Share of a slip that moves evenly over a step that tyres do not feel at its end."""
    return lag_step(jnp.ones(()), jnp.zeros(()), time_of(model, x), dt)[0]


def fading(model: Universal, x: State, felt: Felt, u: Control, dt: Array) -> Aux:
    """What the tyres are behind in the mean over a step if the slip stands still: no rates are needed for that."""
    mean, _ = lag_step(felt.slip - slip_of(model, x, u), jnp.zeros(2), time_of(model, x), dt)
    return Aux(mean, jnp.zeros(()))


def follow(model: Universal, x: State, u: Control, dx: State, ay: Array) -> Targets:
    """Geometric slip angles, their rates at the rates `dx`, and the lateral acceleration."""
    alpha, alpha_dot = jax.jvp(lambda y: slip_of(model, y, u), (x,), (dx,))
    return Targets(alpha, alpha_dot, ay, time_of(model, x))


def settled(model: Universal, x: State, u: Control, place: Place) -> Felt:
    """What is felt where the state has been moving as it does now for longer than the lags."""
    at = follow(model, x, u, *motion(model, x, u, place, Aux(jnp.zeros(2), jnp.zeros(()))))
    return Felt(at.slip - at.time * at.slip_rate, at.ay)


def lagged(model: Universal, felt: Felt, at: Targets, dt: Array) -> tuple[Aux, Felt]:
    """What lags over a step (its mean), and what is behind at its end; exact for slip that moves evenly."""
    behind = at.time * at.slip_rate
    mean, end = lag_step(felt.slip - at.slip + behind, jnp.zeros(2), at.time, dt)
    ay_mean, ay_end = lag_step(felt.ay, at.ay, model.car.roll_lag, dt)
    return Aux(mean - behind, ay_mean - at.ay), Felt(end - behind, ay_end)


def felt_after(model: Universal, felt: Felt, at: Targets, x: State, u: Control, dt: Array) -> Felt:
    """What is felt at the end `x` of a step that began at `at`: the slip has moved there evenly."""
    slip = slip_of(model, x, u)
    behind = lagged(model, felt, at._replace(slip_rate=(slip - at.slip) / dt), dt)[1]
    return Felt(slip + behind.slip, behind.ay)


def advance(
    model: Universal,
    x: State,
    felt: Felt,
    u: Control,
    place: Place,
    dt: Array,
    push: State | None = None,
    step=rk4_step,
) -> tuple[State, Felt]:
    """State and what is felt one step `dt` [s] later, under `u` held.

    `push` is added to the rates; `step` is the integrator. The error is of second order in `dt` with tyres that lag.
    """
    at = follow(model, x, u, *motion(model, x, u, place, fading(model, x, felt, u, dt)))
    aux, _ = lagged(model, felt, at, dt)

    def rate(y: State) -> State:
        dx = motion(model, y, u, place, aux)[0]
        return dx if push is None else axpy(1.0, push, dx)

    x = step(rate, x, dt)
    return x, felt_after(model, felt, at, x, u, dt)


def begin(model: Universal, x0: Float[Array, "3"], before: Float[Array, "2"], place: Place) -> Float[Array, "6"]:
    """State and what is felt, in one vector, at a start `x0` = (V, beta, r) reached under the commands `before`."""
    x = State(x0[0], x0[1], x0[2])
    felt = settled(model, x, Control(before[0], before[1]), place)
    return jnp.concatenate([x0, felt.slip, felt.ay[None]])


def move(
    model: Universal, z: Float[Array, "6"], u: Float[Array, "2"], place: Place, dt: Array, push: State | None = None
) -> Float[Array, "6"]:
    """State and what is felt one step later, under `u` acting; `push` is added to the rates."""

    def on(z):
        x, felt = State(z[0], z[1], z[2]), Felt(z[3:5], z[5])
        x, felt = advance(model, x, felt, Control(u[0], u[1]), place, dt / model.substeps, push)
        return jnp.concatenate([jnp.stack(x), felt.slip, felt.ay[None]])

    return repeated(on, z, model.substeps)


def told(model: Universal, x: Float[Array, "3"], rate: Float[Array, "3"]) -> Float[Array, "3"]:
    """What the sensors tell of the state `x`, which changes at `rate`."""
    return jnp.stack(model.sense(State(x[0], x[1], x[2]), State(rate[0], rate[1], rate[2])))
