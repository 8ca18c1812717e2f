"""Rolling resistance against the forward speed: X - f m g sign(v_x), the sign smooth (Gillespie 1992, Ch. 4)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow, forward_sign
from driftjax.vehicle.single_track import G


def apply(flow: Flow, p) -> Flow:
    """Add a force against the forward speed, proportional to the weight."""
    return flow._replace(X=flow.X - p[0] * flow.car.m * G * forward_sign(flow))


EFFECT = Effect(
    name="rolling_resistance",
    number=14,
    station="force",
    parameters=(Parameter("f", "1", 0.02, lower=0.0, upper=10.0),),
    apply=apply,
    source="Gillespie 1992, Ch. 4",
    sentence="rolling costs more force than in the model",
)
