"""Friction along the lap: mu (1 + sum_i p_i w_i(s)), six windows w_i = (1 + cos(pi d_i)) / 2 for |d_i| < 1, else 0.

d_i = 6 (s - i / 6), around the lap: neighbours overlap, all add up to 1 (raised cosines, Blackman and Tukey 1958).
"""

import jax.numpy as jnp

from driftjax.core.elementary import cos
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow

NUM = 6  # windows around the lap


def apply(flow: Flow, p) -> Flow:
    """Scale the friction of both axles by the value of the patches at the car's place in the lap."""
    change = jnp.zeros_like(flow.place.s)
    for i in range(NUM):
        d = NUM * (jnp.mod(flow.place.s - i / NUM + 0.5, 1.0) - 0.5)
        change = change + p[i] * jnp.where(jnp.abs(d) < 1, (1 + cos(jnp.pi * d)) / 2, 0.0)
    return flow._replace(muf=flow.muf * (1 + change), mur=flow.mur * (1 + change))


EFFECT = Effect(
    name="friction_patch",
    number=37,
    station="friction",
    parameters=tuple(Parameter(f"p_{i + 1}", "1", 0.1) for i in range(NUM)),
    apply=apply,
    source="raised cosines, Blackman and Tukey 1958",
    sentence="the ground has another grip in some parts of the lap",
    needs=("s",),
)
