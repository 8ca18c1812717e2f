"""Longitudinal load transfer: F_zf - h m a_x / L, F_zr + h m a_x / L (Milliken and Milliken 1995, Ch. 18)."""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Move load to the rear under acceleration; h is the height of the centre of mass."""
    moved = p[0] * flow.car.m * flow.ax / flow.car.wheelbase
    return flow._replace(Fzf=flow.Fzf - moved, Fzr=flow.Fzr + moved)


EFFECT = Effect(
    name="load_transfer_long",
    number=9,
    station="load",
    parameters=(Parameter("h", "m", 0.1, "length", lower=0.0),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 18",
    sentence="accelerating moves load to the rear axle and braking to the front",
    reads_acceleration=True,
)
