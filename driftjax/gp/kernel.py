"""Correlation of one pair of points from their difference in length scales; stationary, k(0) = 1."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array


def squared_exponential(d: Array) -> Array:
    """exp(-|d|^2 / 2) (Rasmussen and Williams 2006, Eq. 4.9), `d` the difference over the length scales."""
    return jnp.exp(-0.5 * jnp.sum(d**2))


def _root(q: Array) -> Array:
    """sqrt(q) whose derivative at 0 is 0 instead of infinite."""
    positive = q > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, q, 1.0)), 0.0)


def _matern52_value(q: Array) -> Array:
    r = _root(5.0 * q)
    return (1.0 + r + r**2 / 3.0) * jnp.exp(-r)


_matern52_of_square = jax.custom_jvp(_matern52_value)


def _matern52_jvp(primals, tangents):
    # The derivative in q = |d|^2 is finite at 0; autodiff through the root would cancel there.
    (q,), (dq,) = primals, tangents
    r = _root(5.0 * q)
    return _matern52_of_square(q), -5.0 / 6.0 * (1.0 + r) * jnp.exp(-r) * dq


_matern52_of_square.defjvp(_matern52_jvp)


def matern52(d: Array) -> Array:
    """(1 + r + r^2/3) exp(-r), r = sqrt(5) |d| (Rasmussen and Williams 2006, Eq. 4.17)."""
    return _matern52_of_square(jnp.sum(d**2))


KERNELS: dict[str, Callable[[Array], Array]] = {"se": squared_exponential, "matern52": matern52}
