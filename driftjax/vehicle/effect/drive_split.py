"""Share of the drive force on the front axle: F_xf = p F, F_xr = (1 - p) F for F > 0 (Milliken and Milliken, Ch. 20).

0 is a rear-driven car, 1 a front-driven one. It comes before the tyre forces, which the drive force of their axle
takes from.
"""

import jax.numpy as jnp

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow, move_to_front


def apply(flow: Flow, p) -> Flow:
    """Move drive force from the rear to the front axle."""
    return move_to_front(flow, p[0] * jnp.maximum(flow.u.Fxr, 0.0))


EFFECT = Effect(
    name="drive_split",
    number=45,
    station="slip",
    parameters=(Parameter("p", "1", 0.15, lower=0.0, upper=20 / 3),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 20",
    sentence="a part of the drive force is on the front axle",
)
