"""Step a universal car through a run: state with all lags, position, sensor readings, one fine step."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.core.integrate import HEUN
from driftjax.sim.step import LaggedState, constant_hold, lagged_step
from driftjax.vehicle.effect.flow import Place, heat_rate
from driftjax.vehicle.single_track import SingleTrack
from driftjax.vehicle.universal import Universal

MAX_DELAY = 0.5  # longest sensor delay that the buffer holds; longer ones are truncated to this [s]


class Travel(NamedTuple):
    """State of a run at one instant."""

    x: State
    lagged: LaggedState  # relaxed slip angles and roll's lateral acceleration
    memory: tuple  # of the actuators
    place: Place
    position: Float[Array, "2"]  # x, y [m]
    distance: Array  # travelled [m]
    rate: State  # of the state, over the last step
    acting: Control  # actual steering [rad] and drive [N] over the last step
    past: Float[Array, "n 3"]  # V, beta, r now and at the steps before; no rows without a sensor delay
    step: Array  # length of these steps [s]


def delay_buffer(model: Universal, x: State, h: float) -> Float[Array, "n 3"]:
    """Return the initial delay buffer of a car that has long been in the state `x`, for steps of at least `h` [s]."""
    late = any(effect.sensor_delay for effect in model.effects)
    return jnp.tile(jnp.stack(x), (math.ceil(MAX_DELAY / h) + 2 if late else 0, 1))


def sensor_reading(model: Universal, now: Travel) -> State:
    """Return the noise-free sensor reading at this instant, linear between past steps."""
    if not len(now.past):
        return model.sense(now.x, now.rate)
    steps, model = model.split_delays(now.step)
    row, channel = jnp.minimum(steps.astype(int), len(now.past) - 2), jnp.arange(3)
    x, before = now.past[row, channel], now.past[row + 1, channel]
    return model.sense(State(*x), State(*((x - before) / now.step)))


def travel(
    model: Universal, nominal: SingleTrack, lap: Array, now: Travel, command: Control, h: Array,
    push: State | None = None,
) -> Travel:  # fmt: skip
    """Advance one step `h` [s] under constant `command`, with `push` added to the rates; `lap` is a lap's length [m].

    Tyre heat follows the sliding work of the `nominal` car. The integrator is Heun's method, another one than that of
    the models that predict.
    """
    memory, u = model.apply_actuators(now.memory, command, now.x.V, h)
    x, lagged, *_ = lagged_step(model, now.x, now.lagged, constant_hold(u), now.place, h, push, HEUN)
    course = now.place.psi + now.x.beta
    distance = now.distance + h * now.x.V
    place = Place(
        now.place.t + h, now.place.psi + h * (now.x.r + x.r) / 2, (distance / lap) % 1.0,
        now.place.heat + h * heat_rate(nominal, now.x),
    )  # fmt: skip
    position = now.position + h * now.x.V * jnp.stack([jnp.cos(course), jnp.sin(course)])
    rate = jax.tree.map(lambda a, b: (b - a) / h, now.x, x)
    past = jnp.concatenate([jnp.stack(x)[None], now.past])[: len(now.past)]
    return Travel(x, lagged, memory, place, position, distance, rate, u, past, h)
