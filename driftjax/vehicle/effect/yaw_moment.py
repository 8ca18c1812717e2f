"""Constant yaw moment, left positive, such as of a dragging brake: N + M (Gillespie 1992, Ch. 3)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Turn the car."""
    return flow._replace(N=flow.N + p[0])


EFFECT = Effect(
    name="yaw_moment",
    number=46,
    station="force",
    parameters=(Parameter("M", "N m", 0.01, "moment"),),
    apply=apply,
    source="Gillespie 1992, Ch. 3",
    sentence="a constant moment turns the car, as of a brake that drags on one side",
)
