"""Pure delay of the steering: delta(t) = delta_command(t - d) (Ljung 1999).

Of commands held over steps dt, the mean over a step is a straight line between the two that fall into it.
"""

import math

import jax.numpy as jnp

from driftjax.core import Control
from driftjax.vehicle.effect.base import Effect, Parameter

LONGEST = 0.3  # delay that the memory has room for; a longer one counts as this [s]


def apply(memory, u: Control, V, dt, p):
    """Return the mean delayed angle over the step; `memory` holds the past commands, the latest first."""
    held = jnp.concatenate([jnp.reshape(u.delta, 1), memory])
    steps = jnp.minimum(p[0] / dt, len(memory))
    whole = jnp.clip(jnp.floor(steps), 0, len(memory) - 1)
    share, at = steps - whole, whole.astype(int)
    return held[:-1], u._replace(delta=(1 - share) * held[at] + share * held[at + 1])


def start(dt: float):
    """Return the memory at rest."""
    return jnp.zeros(math.ceil(LONGEST / dt))


EFFECT = Effect(
    name="steer_delay",
    number=32,
    station="command",
    parameters=(Parameter("d", "s", 0.1, "time", lower=0.0, upper=12.0),),
    apply=apply,
    source="Ljung 1999",
    sentence="the steering answers its command after a delay",
    start=start,
)
