"""Gain of the drive: F_xr = F_command (1 + p) (Rajamani 2012, Ch. 5)."""

from driftjax.core import Control
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(memory, u: Control, V, dt, p):
    """Scale the drive and brake force."""
    return memory, u._replace(Fxr=u.Fxr * (1 + p[0]))


EFFECT = Effect(
    name="drive_gain",
    number=17,
    station="command",
    parameters=(Parameter("p", "1", 0.06, lower=-12.0, upper=15.0),),
    apply=apply,
    source="Rajamani 2012, Ch. 5",
    sentence="the drive force is another than the one commanded",
)
