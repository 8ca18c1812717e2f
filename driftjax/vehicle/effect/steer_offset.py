"""Steering offset, left positive: delta = delta_command + p (Gillespie 1992, Ch. 8)."""

from driftjax.core import Control
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(memory, u: Control, V, dt, p):
    """Shift the steering angle."""
    return memory, u._replace(delta=u.delta + p[0])


EFFECT = Effect(
    name="steer_offset",
    number=28,
    station="command",
    parameters=(Parameter("p", "rad", 0.02),),
    apply=apply,
    source="Gillespie 1992, Ch. 8",
    sentence="the wheels do not point straight ahead when the steering command says so",
)
