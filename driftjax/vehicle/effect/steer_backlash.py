"""Backlash of half-width w: delta is the last one, held within delta_command +- w (Nordin and Gutman 2002)."""

import jax.numpy as jnp

from driftjax.core import Control
from driftjax.vehicle.effect.base import Effect, Parameter

TINY = 1e-9  # play below which the wheels always lie at one of its sides [rad]


def apply(memory, u: Control, V, dt, p):
    """Follow the command with the play; `memory` is the last command and the position within the play, from -1 to 1.

    The position is a share of the play, so that the angle has the right slopes at w = 0, where both sides meet.
    """
    last, share = memory
    change, wide = u.delta - last, p[0] > TINY
    inside = jnp.clip(share - change / jnp.where(wide, p[0], 1.0), -1.0, 1.0)
    pressed = jnp.where(change == 0, share, -jnp.sign(change))
    share = jnp.where(wide, inside, pressed)
    return (u.delta, share), u._replace(delta=u.delta + p[0] * share)


def start(dt: float):
    """Return the memory at rest."""
    return (jnp.zeros(()), jnp.zeros(()))


EFFECT = Effect(
    name="steer_backlash",
    number=33,
    station="command",
    parameters=(Parameter("w", "rad", 0.01, lower=0.0),),
    apply=apply,
    source="Nordin and Gutman 2002",
    sentence="the steering has play",
    start=start,
)
