"""Scale of the yaw rate sensor: r_measured = r (1 + p) (Ryu, Rossetter and Gerdes 2002)."""

from driftjax.core import State
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(x: State, dx: State, p) -> State:
    """Scale the yaw rate."""
    return x._replace(r=x.r * (1 + p[0]))


EFFECT = Effect(
    name="gyro_scale",
    number=40,
    station="sensor",
    parameters=(Parameter("p", "1", 0.03),),
    apply=apply,
    source="Ryu, Rossetter and Gerdes 2002",
    sentence="the measured yaw rate is off by a factor",
    kinematic=True,
)
