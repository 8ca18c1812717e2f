"""Bank of the road, falling to the left positive: Y + m g sin(phi) (Ryu and Gerdes 2004)."""

from driftjax.core.elementary import sin
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow
from driftjax.vehicle.single_track import G


def apply(flow: Flow, p) -> Flow:
    """Add the weight's part along the bank, to the left; the bank turns with the car, as in a banked corner."""
    return flow._replace(Y=flow.Y + flow.car.m * G * sin(p[0]))


EFFECT = Effect(
    name="road_bank",
    number=34,
    station="force",
    parameters=(Parameter("phi", "rad", 0.035),),
    apply=apply,
    source="Ryu and Gerdes 2004",
    sentence="the road is banked",
    kinematic=True,
)
