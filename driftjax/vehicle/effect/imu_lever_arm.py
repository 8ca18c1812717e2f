"""Velocity measured at (l_x, l_y) from the centre of mass: (v_x - l_y r, v_y + l_x r) (Ryu and Gerdes 2004).

Split along and across the velocity, so that the true one comes out exactly where there is no arm.
"""

import jax.numpy as jnp

from driftjax.core import State
from driftjax.core.elementary import arctan2, sincos
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.single_track import V_FLOOR


def apply(x: State, dx: State, p) -> State:
    """Return speed and sideslip of the measured point."""
    sin, cos = sincos(x.beta)
    along, across = x.r * (p[0] * sin - p[1] * cos), x.r * (p[0] * cos + p[1] * sin)
    speed = lambda square: jnp.sqrt(square + V_FLOOR**2)
    gain = along * (2 * x.V + along) + across**2
    V = x.V + gain / (speed((x.V + along) ** 2 + across**2) + speed(x.V**2))
    return x._replace(V=V, beta=x.beta + arctan2(across, jnp.maximum(x.V, V_FLOOR) + along))


EFFECT = Effect(
    name="imu_lever_arm",
    number=44,
    station="sensor",
    parameters=(Parameter("l_x", "m", 0.1, "length"), Parameter("l_y", "m", 0.1, "length")),
    apply=apply,
    source="Ryu and Gerdes 2004",
    sentence="speed and sideslip are measured away from the centre of mass",
    kinematic=True,
)
