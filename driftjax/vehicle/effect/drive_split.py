"""Share of drive and brake force on the front axle: F_xf = p F, F_xr = (1 - p) F (Milliken and Milliken 1995, Ch. 20).

It comes before the tyre forces, which the drive force of their axle takes from.
"""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Move force from the rear to the front axle."""
    return flow._replace(Fxf=flow.Fxf + p[0] * flow.Fxr, Fxr=flow.Fxr * (1 - p[0]))


EFFECT = Effect(
    name="drive_split",
    number=45,
    station="slip",
    parameters=(Parameter("p", "1", 0.15, lower=0.0),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 20",
    sentence="a part of the drive force is on the front axle",
)
