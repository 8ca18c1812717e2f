"""Records that all layers share: state, control and GP input."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def as_float(value: ArrayLike) -> Array:
    """Convert to a float array (field converter), so that a new value does not cause a new compilation."""
    return jnp.asarray(value, dtype=jnp.result_type(float))


class State(NamedTuple):
    """State of the single-track car (Wu et al. 2025, Eq. 1): V [m/s], beta [rad], r [rad/s], left positive.

    Fields are scalars or arrays of one batch shape.
    """

    V: Array  # speed of the centre of mass [m/s]
    beta: Array  # sideslip, atan2(v_y, v_x), left positive [rad]
    r: Array  # yaw rate, left positive [rad/s]


class Control(NamedTuple):
    """Inputs of the car: road-wheel angle delta [rad], left positive, and rear longitudinal force Fxr [N].

    Fields are scalars or arrays of one batch shape.
    """

    delta: Array  # front-wheel steering angle, left positive [rad]
    Fxr: Array  # longitudinal force of the rear axle, driving positive [N]


def features(x: State, u: Control) -> Array:
    """Return the GP input z = (V, beta, r, delta, Fxr), stacked on the last axis (Wu et al. 2025, Sec. IV-B)."""
    return jnp.stack([x.V, x.beta, x.r, u.delta, u.Fxr], axis=-1)
