"""Classify the kind of a steady state."""

from enum import IntEnum

import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, State
from driftjax.vehicle import AnyCar


class Branch(IntEnum):
    """Kinds of steady state; a drift has its rear axle beyond the peak and slides outwards (beta r < 0)."""

    OTHER = 0  # rear within the peak but front beyond it, or both but sliding inwards
    GRIP = 1  # both axles within the peak
    COUNTERSTEER = 2  # a drift with the front axle within the peak: the one that drivers use
    FRONT_SATURATED = 3  # a drift with the front axle beyond the peak too


def classify(nominal: AnyCar, x: State, u: Control) -> Array:
    """Return the `Branch` of one point as an integer, from the slip angles of the car."""
    alpha_f, alpha_r = nominal.slip_angles(x, u)
    front, rear = nominal.peaks
    front_grips, rear_grips = jnp.abs(alpha_f) < front, jnp.abs(alpha_r) < rear
    drift = (x.beta * x.r < 0) & ~rear_grips
    slide = jnp.where(front_grips, Branch.COUNTERSTEER, Branch.FRONT_SATURATED)
    grip = jnp.where(front_grips & rear_grips, Branch.GRIP, Branch.OTHER)
    return jnp.where(drift, slide, grip)
