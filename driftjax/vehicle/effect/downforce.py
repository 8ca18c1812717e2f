"""Downforce: F_zf + c V^2 b / L, F_zr + c V^2 a / L, c = rho C_l A / 2 (Milliken and Milliken 1995, Ch. 15).

Negative is lift. It acts at the centre of mass; another balance shows as front or rear friction that goes with speed.
"""

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Add to both axle loads a force that grows with the square of speed, split as the weight is."""
    share = p[0] * flow.x.V**2 / flow.car.wheelbase
    return flow._replace(Fzf=flow.Fzf + share * flow.car.b, Fzr=flow.Fzr + share * flow.car.a)


EFFECT = Effect(
    name="downforce",
    number=15,
    station="load",
    parameters=(Parameter("c", "N s^2/m^2", 0.001, "drag"),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 15",
    sentence="the air presses the car down, or lifts it, as it gets faster",
)
