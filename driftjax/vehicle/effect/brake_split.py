"""Share of the brake force on the front axle: F_xf = p F, F_xr = (1 - p) F where F < 0 (Milliken and Milliken 1995,
Ch. 20).

The nominal car brakes with the axle that it drives, cars on the road with both; `drive_split` is the share of either.
"""

import jax.numpy as jnp

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow


def apply(flow: Flow, p) -> Flow:
    """Move brake force from the rear to the front axle."""
    moved = p[0] * jnp.minimum(flow.Fxr, 0.0)
    return flow._replace(Fxf=flow.Fxf + moved, Fxr=flow.Fxr - moved)


EFFECT = Effect(
    name="brake_split",
    number=48,
    station="slip",
    parameters=(Parameter("p", "1", 0.3, lower=0.0, upper=10 / 3),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 20",
    sentence="a part of the brake force is on the front axle",
)
