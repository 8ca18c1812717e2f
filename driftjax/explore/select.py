"""Select the next candidate to drive: Algorithm 1 of the paper."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.gp import GP


class Choice(NamedTuple):
    """Result of one selection; `candidate` is undefined where `exhausted`."""

    candidate: Array  # index of the one to drive next
    score: Array  # (n,) lambda V - (1 - lambda) D, -inf for visited ones
    distance: Array  # (n,) D over its largest among the unvisited [-]
    variance: Array  # (n,) V over its largest among the unvisited [-]
    exhausted: Array  # every candidate has been visited


def _share(value: Array, allowed: Array) -> Array:
    """Return `value` relative to its largest where `allowed`; 0 where that is 0."""
    largest = jnp.max(jnp.where(allowed, value, 0.0))
    positive = largest > 0
    return jnp.where(positive, value / jnp.where(positive, largest, 1.0), 0.0)


def select(candidates: Array, visited: Array, z_ref: Array, gp: GP, P: Array, lam: float | Array) -> Choice:
    """Select the most informative unvisited candidate near the reference: argmax of lambda V_j - (1 - lambda) D_j.

    (Wu et al. 2025, Algorithm 1.) `candidates` (n, nf), `visited` (n,), `z_ref` (nf,). D_j is the distance to `z_ref`
    in the GP's input scales, V_j = sum_i P_i Sigma_i(z_j) / prior variance_i with the outputs ordered (dV, dbeta, dr).
    Both are divided by their largest among the unvisited, so that `lam` in [0, 1] weighs quantities of equal scale.
    """
    open_ = ~visited.astype(bool)
    distance = jnp.sqrt(jnp.sum(((candidates - z_ref) / gp.scale) ** 2, axis=-1))
    variance = jax.vmap(lambda z: jnp.sum(P * gp.variance(z) / gp.prior_variance))(candidates)
    D, V = _share(distance, open_), _share(variance, open_)
    score = jnp.where(open_, lam * V - (1 - lam) * D, -jnp.inf)
    return Choice(jnp.argmax(score), score, D, V, ~jnp.any(open_))
