"""Friction of the rear axle: mu_r (1 + p) (Pacejka 2012, Sec. 4)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Scale the friction of the rear axle."""
    return flow._replace(mur=flow.mur * (1 + p[0]))


EFFECT = Effect(
    name="friction_rear",
    number=3,
    station="friction",
    parameters=(Parameter("p", "1", 0.06, lower=-14.0, upper=10.0),),
    apply=apply,
    source="Pacejka 2012, Sec. 4",
    sentence="the rear tyres have another friction than the model's",
)
