"""Bias of the yaw rate sensor: r_measured = r + p (Ryu, Rossetter and Gerdes 2002)."""

from driftjax.core import State
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(x: State, dx: State, p) -> State:
    """Shift the yaw rate."""
    return x._replace(r=x.r + p[0])


EFFECT = Effect(
    name="gyro_bias",
    number=39,
    station="sensor",
    parameters=(Parameter("p", "rad/s", 0.01, "yaw_rate"),),
    apply=apply,
    source="Ryu, Rossetter and Gerdes 2002",
    sentence="the measured yaw rate is off by a constant",
    kinematic=True,
)
