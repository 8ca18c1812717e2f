"""Roll out the universal car under given commands: actuator response, motion, and sensor readings."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.sim.step import LaggedState, hold_of, hold_segment, lagged_step, midpoints, steady_lagged_state
from driftjax.vehicle.effect.flow import Place
from driftjax.vehicle.universal import Universal

SETTLE = 1.0  # time after which the initial actuator state no longer matters [s]
FINE = 4  # substeps of the actuator simulation per step
WHERE = midpoints(FINE)


class StepResult(NamedTuple):
    """State at the end of a step, and the rates over it."""

    z: Float[Array, "6"]  # state and lagged state
    rates: Float[Array, "3 3"]  # of V, beta, r: mean over the step, at its start and at its end


def actuator_response(
    model: Universal, commands: Float[Array, "w 2"], V: Float[Array, " w"], dt: float,
    changes: Float[Array, "w 2"] | None = None,
) -> Float[Array, "w 4"]:  # fmt: skip
    """Return means and slopes of the actuator response from rest to commands: steering [rad], drive [N].

    `commands` are means over each step, in which they change linearly by `changes`; without these they are held.
    Lags and delays have finite memory: start `SETTLE` before the commands of interest.
    """
    changes = jnp.zeros_like(commands) if changes is None else changes

    def move(memory, row):
        command, change, speed = row

        def fine(memory, where):
            now = command + where * change / 2
            return model.apply_actuators(memory, Control(now[0], now[1]), speed, dt / FINE)

        memory, u = jax.lax.scan(fine, memory, jnp.asarray(WHERE))
        u = jnp.stack(u)
        return memory, jnp.concatenate([u.mean(axis=1), (u * WHERE).mean(axis=1) / np.mean(WHERE**2)])

    return jax.lax.scan(move, model.start(dt / FINE), (commands, changes, V))[1]


def begin(model: Universal, x0: Float[Array, "3"], before: Float[Array, "4"], place: Place) -> Float[Array, "6"]:
    """Return state and lagged state as one vector, at a start `x0` = (V, beta, r) reached under the inputs `before`."""
    x = State(x0[0], x0[1], x0[2])
    lagged = steady_lagged_state(model, x, hold_of(before).mean, place)
    return jnp.concatenate([x0, lagged.slip, lagged.ay[None]])


def move(
    model: Universal, z: Float[Array, "6"], u: Float[Array, "4"], place: Place, dt: Array, push: State | None = None
) -> StepResult:
    """Return state and lagged state after a step under inputs `u` (means, slopes); `push` is added to the rates."""

    def on(z, u):
        x, lagged = State(z[0], z[1], z[2]), LaggedState(z[3:5], z[5])
        x, lagged, *ends = lagged_step(model, x, lagged, hold_of(u), place, dt / model.substeps, push)
        return jnp.concatenate([jnp.stack(x), lagged.slip, lagged.ay[None]]), jnp.stack(
            [jnp.stack(end) for end in ends]
        )

    if model.substeps == 1:
        after, (first, last) = on(z, u)
    else:
        one = lambda z, middle: on(z, hold_segment(u, middle, model.substeps))
        after, each = jax.lax.scan(one, z, midpoints(model.substeps))
        first, last = each[0, 0], each[-1, 1]
    return StepResult(after, jnp.stack([(after[:3] - z[:3]) / dt, first, last]))


def sensor_reading(model: Universal, x: Float[Array, "3"], rates: Float[Array, "3 3"], dt: Array) -> Float[Array, "3"]:
    """Return the noise-free sensor reading of `x`, delayed by less than a step, from the `rates` of the last step.

    Within that step the state follows the cubic through its ends with the rates there.
    """
    _, model = model.split_delays(dt)
    late, (mean, first, last) = model.sensor_delays() / dt, rates
    quadratic = 3 * mean - first - 2 * last  # the cubic is x - dt (late last + late^2 quadratic + late^3 cubic)
    cubic = first + last - 2 * mean
    return jnp.stack(model.sense(State(*x), State(*(last + late * quadratic + late**2 * cubic))))
