"""Aerodynamic drag against the velocity: X - c V^2 cos(beta), Y - c V^2 sin(beta), c = rho C_d A / 2 (SAE J1263)."""

from driftjax.core.elementary import sincos
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Add a force against the velocity, proportional to its square."""
    drag, (sin, cos) = p[0] * flow.x.V**2, sincos(flow.x.beta)
    return flow._replace(X=flow.X - drag * cos, Y=flow.Y - drag * sin)


EFFECT = Effect(
    name="aero_drag",
    number=13,
    station="force",
    parameters=(Parameter("c", "N s^2/m^2", 0.0012, "drag", lower=0.0),),
    apply=apply,
    source="SAE J1263 (2010)",
    sentence="the air holds the car back",
)
