"""Friction of the front axle: mu_f (1 + p) (Pacejka 2012, Sec. 4)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Scale the friction of the front axle."""
    return flow._replace(muf=flow.muf * (1 + p[0]))


EFFECT = Effect(
    name="friction_front",
    number=2,
    station="friction",
    parameters=(Parameter("p", "1", 0.06, lower=-14.0, upper=10.0),),
    apply=apply,
    source="Pacejka 2012, Sec. 4",
    sentence="the front tyres have another friction than the model's",
)
