"""Drag of the engine or of regeneration: X - F step(-F_xr) sign(v_x), both smooth (Gillespie 1992, Ch. 2).

The step is 98 % at lift-off (F_xr = 0), half at a drive force of 2 % of the weight and 2 % at 4 %.
"""

import jax

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow, forward_sign
from driftjax.vehicle.single_track import G

CENTRE, WIDTH = 0.02, 0.005  # drive force at which it lets go, over the weight [-]


def apply(flow: Flow, p) -> Flow:
    """Add a force against the forward speed where the car is not driven."""
    drive = flow.u.Fxr / (flow.car.m * G)
    return flow._replace(X=flow.X - p[0] * jax.nn.sigmoid((CENTRE - drive) / WIDTH) * forward_sign(flow))


EFFECT = Effect(
    name="engine_drag",
    number=16,
    station="force",
    parameters=(Parameter("F", "N", 0.03, "force", lower=0.0, upper=10.0),),
    apply=apply,
    source="Gillespie 1992, Ch. 2",
    sentence="with the throttle closed the engine holds the car back",
)
