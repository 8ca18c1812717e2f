"""Fade with the heat q put into the rear tyres: mu_r exp(-k q), mu_f exp(-k q / 2) (after Farroni et al. 2014).

The exponential is 1 - k q while that is small, and never takes more than all. The front, which slides less, gets half.
"""

import jax.numpy as jnp

from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow

FRONT = 0.5  # share of the rear's fade that the front has [-]


def apply(flow: Flow, p) -> Flow:
    """Lower the friction exponentially with the sliding work of the rear tyres."""
    fade = p[0] * flow.place.heat
    return flow._replace(muf=flow.muf * jnp.exp(-FRONT * fade), mur=flow.mur * jnp.exp(-fade))


EFFECT = Effect(
    name="friction_fade",
    number=38,
    station="friction",
    parameters=(Parameter("k", "1", 0.5),),
    apply=apply,
    source="Farroni et al. 2014",
    sentence="the tyres lose grip as they heat up and wear",
    transient=True,
)
