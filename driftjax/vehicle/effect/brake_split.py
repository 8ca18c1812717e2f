"""Share of the brake force on the front axle: F_xf = p F, F_xr = (1 - p) F for F < 0 (Milliken and Milliken, Ch. 20).

0 is a car that brakes with its rear axle only, as by a motor there; 0.6 to 0.75 is common with brakes on all wheels.
"""

import jax.numpy as jnp

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow, move_to_front


def apply(flow: Flow, p) -> Flow:
    """Move brake force from the rear to the front axle."""
    return move_to_front(flow, p[0] * jnp.minimum(flow.u.Fxr, 0.0))


EFFECT = Effect(
    name="brake_split",
    number=48,
    station="slip",
    parameters=(Parameter("p", "1", 0.25, lower=0.0),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 20",
    sentence="a part of the brake force is on the front axle",
)
