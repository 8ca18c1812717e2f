"""Scale of the measured speed: V_measured = V (1 + p), as of another wheel radius (Carlson and Gerdes 2005)."""

from driftjax.core import State
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(x: State, dx: State, p) -> State:
    """Scale the speed."""
    return x._replace(V=x.V * (1 + p[0]))


EFFECT = Effect(
    name="speed_scale",
    number=42,
    station="sensor",
    parameters=(Parameter("p", "1", 0.03),),
    apply=apply,
    source="Carlson and Gerdes 2005",
    sentence="the measured speed is off by a factor",
    kinematic=True,
)
