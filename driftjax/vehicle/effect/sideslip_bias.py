"""Bias of the measured sideslip: beta_measured = beta + p (Ryu, Rossetter and Gerdes 2002)."""

from driftjax.core import State
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(x: State, dx: State, p) -> State:
    """Shift the sideslip."""
    return x._replace(beta=x.beta + p[0])


EFFECT = Effect(
    name="sideslip_bias",
    number=41,
    station="sensor",
    parameters=(Parameter("p", "rad", 0.02),),
    apply=apply,
    source="Ryu, Rossetter and Gerdes 2002",
    sentence="the measured sideslip is off by a constant",
    kinematic=True,
)
