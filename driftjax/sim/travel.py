"""A universal car on its way: its state with all that lags, where it is, and one fine step of it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.core.integrate import heun_step
from driftjax.sim.rollout import Felt, advance
from driftjax.vehicle.effect.flow import Place, heat_rate
from driftjax.vehicle.single_track import SingleTrack
from driftjax.vehicle.universal import Universal


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


def travel(
    model: Universal, nominal: SingleTrack, lap: Array, now: Travel, command: Control, h: Array,
    push: State | None = None,
) -> Travel:  # fmt: skip
    """One step `h` [s] later under `command` held; `push` is added to the rates, `lap` is the length of one lap [m].

    Tyres warm up by the sliding work of the `nominal` car. Heun's method: not the one by which models predict.
    """
    memory, u = model.act(now.memory, command, now.x.V, h)
    x, felt = advance(model, now.x, now.felt, u, now.place, h, push, heun_step)
    course = now.place.psi + now.x.beta
    distance = now.distance + h * now.x.V
    place = Place(
        now.place.t + h, now.place.psi + h * (now.x.r + x.r) / 2, (distance / lap) % 1.0,
        now.place.heat + h * heat_rate(nominal, now.x),
    )  # fmt: skip
    position = now.position + h * now.x.V * jnp.stack([jnp.cos(course), jnp.sin(course)])
    rate = jax.tree.map(lambda a, b: (b - a) / h, now.x, x)
    return Travel(x, felt, memory, place, position, distance, rate, u)
