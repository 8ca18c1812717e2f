"""Roll-outs of the universal car under given commands: what its actuators reach, how it moves, what sensors tell."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.core.integrate import rk4_ends
from driftjax.sim.step import Acts, Felt, acts_of, begin_step, felt_after, middles, part, rate_during, settled
from driftjax.vehicle.effect.flow import Place
from driftjax.vehicle.universal import Universal

SETTLE = 1.0  # time after which actuators have forgotten where they began [s]
FINE = 4  # parts of a step in which actuators are followed
WHERE = middles(FINE)


class Moved(NamedTuple):
    """The end of a step, and how the state got there."""

    z: Float[Array, "6"]  # state and what is felt
    rates: Float[Array, "3 3"]  # of V, beta, r: mean over the step, at its begin and at its end


def acting(model: Universal, commands: Float[Array, "w 2"], V: Float[Array, " w"], dt: float) -> Float[Array, "w 4"]:
    """What steering [rad] and drive [N] make of commands held for one step each, from rest: means and tilts.

    Lags and delays forget: give `SETTLE` of commands before those of interest.
    """

    def move(memory, row):
        command, speed = row
        fine = lambda memory, _: model.apply_actuators(memory, Control(command[0], command[1]), speed, dt / FINE)
        memory, u = jax.lax.scan(fine, memory, length=FINE)
        u = jnp.stack(u)
        return memory, jnp.concatenate([u.mean(axis=1), (u * WHERE).mean(axis=1) / np.mean(WHERE**2)])

    return jax.lax.scan(move, model.start(dt / FINE), (commands, V))[1]


def advance(
    model: Universal, x: State, felt: Felt, acts: Acts, place: Place, dt: Array, push: State | None = None
) -> tuple[State, Felt, State, State]:
    """State and what is felt one step `dt` [s] later, and the rates of the state at its begin and end."""
    begun = begin_step(model, x, felt, acts, place, dt, push)
    rate = rate_during(model, begun, place, dt, push)
    (x, _), (first, _), (last, _) = rk4_ends(rate, (x, jnp.zeros(())), dt)
    return x, felt_after(model, begun, x, dt), first, last


def begin(model: Universal, x0: Float[Array, "3"], before: Float[Array, "4"], place: Place) -> Float[Array, "6"]:
    """State and what is felt, in one vector, at a start `x0` = (V, beta, r) reached under the commands `before`."""
    x = State(x0[0], x0[1], x0[2])
    felt = settled(model, x, acts_of(before).mean, place)
    return jnp.concatenate([x0, felt.slip, felt.ay[None]])


def move(
    model: Universal, z: Float[Array, "6"], u: Float[Array, "4"], place: Place, dt: Array, push: State | None = None
) -> Moved:
    """State and what is felt one step later, under `u` acting (means and tilts); `push` is added to the rates."""

    def on(z, u):
        x, felt = State(z[0], z[1], z[2]), Felt(z[3:5], z[5])
        x, felt, *ends = advance(model, x, felt, acts_of(u), place, dt / model.substeps, push)
        return jnp.concatenate([jnp.stack(x), felt.slip, felt.ay[None]]), jnp.stack([jnp.stack(end) for end in ends])

    if model.substeps == 1:
        after, (first, last) = on(z, u)
    else:
        one = lambda z, middle: on(z, part(u, middle, model.substeps))
        after, each = jax.lax.scan(one, z, middles(model.substeps))
        first, last = each[0, 0], each[-1, 1]
    return Moved(after, jnp.stack([(after[:3] - z[:3]) / dt, first, last]))


def told(model: Universal, x: Float[Array, "3"], rates: Float[Array, "3 3"], dt: Array) -> Float[Array, "3"]:
    """What the sensors tell of the state `x`, whole steps of their delay apart; `rates` are those of the last step.

    Within that step the state goes along the cubic through its ends with the rates there.
    """
    _, model = model.split_delays(dt)
    late, (mean, first, last) = model.sensor_delays() / dt, rates
    bend = 3 * mean - first - 2 * last  # the cubic is x - dt (late last + late^2 bend + late^3 twist)
    twist = first + last - 2 * mean
    return jnp.stack(model.sense(State(*x), State(*(last + late * bend + late**2 * twist))))
