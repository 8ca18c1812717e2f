"""Stationary correlation functions of q, the squared distance of two points in length scales; k(0) = 1."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array


def squared_exponential(q: Array) -> Array:
    """Return exp(-q / 2) (Rasmussen and Williams 2006, Eq. 4.9)."""
    return jnp.exp(-0.5 * q)


def _root(q: Array) -> Array:
    """Return sqrt(q), with derivative 0 instead of infinity at 0."""
    positive = q > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, q, 1.0)), 0.0)


def _matern52(q: Array) -> Array:
    """Return (1 + r + r^2/3) exp(-r), r = sqrt(5 q) (Rasmussen and Williams 2006, Eq. 4.17)."""
    r = _root(5.0 * q)
    return (1.0 + r + r**2 / 3.0) * jnp.exp(-r)


def _matern52_jvp(primals, tangents):
    # The derivative in q is finite at 0; autodiff through the root would cancel there.
    (q,), (dq,) = primals, tangents
    r = _root(5.0 * q)
    return _matern52(q), -5.0 / 6.0 * (1.0 + r) * jnp.exp(-r) * dq


matern52 = jax.custom_jvp(_matern52)
matern52.defjvp(_matern52_jvp)

KERNELS: dict[str, Callable[[Array], Array]] = {"se": squared_exponential, "matern52": matern52}
