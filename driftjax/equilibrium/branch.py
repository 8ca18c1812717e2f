"""Which kind of steady state a point of the nominal car is."""

from enum import IntEnum

import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, State
from driftjax.vehicle import SingleTrack


class Branch(IntEnum):
    """Kinds of steady state; a drift has its rear axle beyond the peak and slides outwards (beta r < 0)."""

    OTHER = 0  # rear within the peak but front beyond it, or both slides the wrong way
    GRIP = 1  # both axles within the peak
    COUNTERSTEER = 2  # a drift with the front axle within the peak: the one drivers hold
    FRONT_SATURATED = 3  # a drift with the front axle beyond the peak too


def classify(nominal: SingleTrack, x: State, u: Control) -> Array:
    """`Branch` of one point as an integer, judged by the slip angles of the nominal car."""
    alpha_f, alpha_r = nominal.slip_angles(x, u)
    peak = nominal.tyre.alpha_peak
    front_grips, rear_grips = jnp.abs(alpha_f) < peak, jnp.abs(alpha_r) < peak
    drift = (x.beta * x.r < 0) & ~rear_grips
    slide = jnp.where(front_grips, Branch.COUNTERSTEER, Branch.FRONT_SATURATED)
    grip = jnp.where(front_grips & rear_grips, Branch.GRIP, Branch.OTHER)
    return jnp.where(drift, slide, grip)
