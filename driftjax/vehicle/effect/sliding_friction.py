"""Friction that falls with the sliding speed V_s: mu (1 - k (1 - exp(-V_s / V_st))) (Burckhardt 1993; LuGre's steady
state, Canudas de Wit et al. 1999).

k is the loss in full sliding; V_st is fixed at sqrt(g L), 5.5 m/s for a sedan: at k = 0 it is not identifiable.
"""

import jax.numpy as jnp

from driftjax.core.elementary import sin
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Flow

BOTTOM = 0.02  # width over which the absolute value is rounded, over sqrt(g L) [-]


def apply(flow: Flow, p) -> Flow:
    """Lower the friction of each axle with its own sliding speed, V |sin alpha|, smooth at 0."""
    unit, x = flow.car.unit_speed, flow.x

    def share_left(alpha):
        share = x.V * sin(alpha) / unit
        speed = jnp.sqrt(share**2 + BOTTOM**2) - BOTTOM
        return 1 - p[0] * (1 - jnp.exp(-speed))

    return flow._replace(muf=flow.muf * share_left(flow.alpha_f), mur=flow.mur * share_left(flow.alpha_r))


EFFECT = Effect(
    name="sliding_friction",
    number=7,
    station="friction",
    parameters=(Parameter("k", "1", 0.1),),
    apply=apply,
    source="Burckhardt 1993; Canudas de Wit et al. 1999",
    sentence="the tyres lose grip the faster they slide",
)
