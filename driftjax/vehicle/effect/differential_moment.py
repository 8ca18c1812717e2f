"""Yaw moment of the differential: N + k F_xr sign(r), the sign smooth (Milliken and Milliken 1995, Ch. 20).

k is the arm at which the drive force acts, at most half the track; positive at the outer wheel, into the turn.
"""

import jax.numpy as jnp

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow

WIDTH = 0.05  # of the smooth sign, over sqrt(g / L) [-]


def apply(flow: Flow, p) -> Flow:
    """Add a yaw moment proportional to the drive force, in the direction of the yaw rate."""
    r, width = flow.x.r, WIDTH * flow.car.unit_speed / flow.car.wheelbase
    return flow._replace(N=flow.N + p[0] * flow.Fxr * r / jnp.sqrt(r**2 + width**2))


EFFECT = Effect(
    name="differential_moment",
    number=21,
    station="force",
    parameters=(Parameter("k", "m", 0.05, "length"),),
    apply=apply,
    source="Milliken and Milliken 1995, Ch. 20",
    sentence="the differential turns the car as it is driven",
)
