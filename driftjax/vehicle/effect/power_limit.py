"""Power limit: F_xr = F / (1 + p V F) for a drive force F > 0, p = 1 / P_max (Gillespie 1992, Ch. 2).

The power p V F / (1 + p V F) P_max nears P_max softly: a sharper limit would have no slope at p = 0.
"""

import jax.numpy as jnp

from driftjax.core import Control
from driftjax.vehicle.effect.base import Effect, Parameter


def apply(memory, u: Control, V, dt, p):
    """Limit the power of the drive to 1 / p; braking is unchanged."""
    return memory, u._replace(Fxr=u.Fxr / (1 + p[0] * V * jnp.maximum(u.Fxr, 0.0)))


EFFECT = Effect(
    name="power_limit",
    number=19,
    station="command",
    parameters=(Parameter("p", "1/W", 0.4, "per_power", lower=0.0),),
    apply=apply,
    source="Gillespie 1992, Ch. 2",
    sentence="the drive runs out of power at speed",
)
