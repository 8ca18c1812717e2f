"""A universal car on its way: its state with all that lags, where it is, what its sensors tell, one fine step of it."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.core.integrate import heun_step
from driftjax.sim.step import Felt, begin_step, felt_after, held, rate_during
from driftjax.vehicle.effect.flow import Place, heat_rate
from driftjax.vehicle.single_track import SingleTrack
from driftjax.vehicle.universal import Universal

LONGEST = 0.5  # delay of a sensor that its memory has room for; a longer one counts as this [s]


class Travel(NamedTuple):
    """One instant of a drive."""

    x: State
    felt: Felt  # slip angles and lateral acceleration that tyres and body have reached
    memory: tuple  # of the actuators
    place: Place
    position: Float[Array, "2"]  # x, y [m]
    distance: Array  # driven so far [m]
    rate: State  # of the state, over the last step
    acting: Control  # what steering [rad] and drive [N] were over the last step
    past: Float[Array, "n 3"]  # V, beta, r now and at the steps before; no row where no sensor is late
    step: Array  # length of these steps [s]


def recall(model: Universal, x: State, h: float) -> Float[Array, "n 3"]:
    """What `past` holds of a car that has long been in the state `x`, for steps of `h` [s] or longer."""
    late = any(effect.sensor_delay for effect in model.effects)
    return jnp.tile(jnp.stack(x), (math.ceil(LONGEST / h) + 2 if late else 0, 1))


def told(model: Universal, now: Travel) -> State:
    """What the sensors tell at this instant, noise apart; between past steps the state is taken for a straight line."""
    if not len(now.past):
        return model.sense(now.x, now.rate)
    whole, model = model.split_delays(now.step)
    row, channel = jnp.minimum(whole.astype(int), len(now.past) - 2), jnp.arange(3)
    x, before = now.past[row, channel], now.past[row + 1, channel]
    return model.sense(State(*x), State(*((x - before) / now.step)))


def travel(
    model: Universal, nominal: SingleTrack, lap: Array, now: Travel, command: Control, h: Array,
    push: State | None = None,
) -> Travel:  # fmt: skip
    """One step `h` [s] later under `command` held; `push` is added to the rates, `lap` is the length of one lap [m].

    Tyres warm up by the sliding work of the `nominal` car. Heun's method: not the one by which models predict.
    """
    memory, u = model.apply_actuators(now.memory, command, now.x.V, h)
    begun = begin_step(model, now.x, now.felt, held(u), now.place, h, push)
    x, _ = heun_step(rate_during(model, begun, now.place, h, push), (now.x, jnp.zeros(())), h)
    felt = felt_after(model, begun, x, h)
    course = now.place.psi + now.x.beta
    distance = now.distance + h * now.x.V
    place = Place(
        now.place.t + h, now.place.psi + h * (now.x.r + x.r) / 2, (distance / lap) % 1.0,
        now.place.heat + h * heat_rate(nominal, now.x),
    )  # fmt: skip
    position = now.position + h * now.x.V * jnp.stack([jnp.cos(course), jnp.sin(course)])
    rate = jax.tree.map(lambda a, b: (b - a) / h, now.x, x)
    past = jnp.concatenate([jnp.stack(x)[None], now.past])[: len(now.past)]
    return Travel(x, felt, memory, place, position, distance, rate, u, past, h)
