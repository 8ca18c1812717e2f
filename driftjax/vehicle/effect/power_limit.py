"""Power limit: F_xr = F / (1 + 0.4 x + x^8)^(1/8), x = p V F, for a drive force F > 0, p = 1 / P_max (Gillespie 1992).

Nearly min(F, P_max / V), as engines and motors have it: 10 % below it at x = 1, 2 % at 1/2, 0.1 % at 2. Without the
linear term there would be no slope at p = 0, and data could not show that there is a limit.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from driftjax.core import Control
from driftjax.vehicle.effect.base import Effect, Parameter

SLOPE = 0.4  # of the linear term


def limited_force(F: Float[Array, "..."], V: Float[Array, "..."], p: float | Float[Array, ""]) -> Float[Array, "..."]:
    """Return the drive force [N] within the power 1 / `p` [W] at speed `V` [m/s]; braking (F < 0) is unchanged."""
    x = p * V * jnp.maximum(F, 0.0)
    return F / jnp.sqrt(jnp.sqrt(jnp.sqrt(1 + SLOPE * x + x**8)))


def apply(memory, u: Control, V, dt, p):
    """Limit the power of the drive to 1 / p; braking is unchanged."""
    return memory, u._replace(Fxr=limited_force(u.Fxr, V, p[0]))


EFFECT = Effect(
    name="power_limit",
    number=19,
    station="command",
    parameters=(Parameter("p", "1/W", 1.0, "per_power", lower=0.0),),
    apply=apply,
    source="Gillespie 1992, Ch. 2",
    sentence="the drive runs out of power at speed",
)
