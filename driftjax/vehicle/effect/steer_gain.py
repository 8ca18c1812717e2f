"""Steering ratio: delta = delta_command (1 + p) (Gillespie 1992, Ch. 8)."""

from driftjax.core import Control
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(memory, u: Control, V, dt, p):
    """Scale the steering angle."""
    return memory, u._replace(delta=u.delta * (1 + p[0]))


EFFECT = Effect(
    name="steer_gain",
    number=29,
    station="command",
    parameters=(Parameter("p", "1", 0.06),),
    apply=apply,
    source="Gillespie 1992, Ch. 8",
    sentence="the wheels turn by more or less than the steering command",
)
