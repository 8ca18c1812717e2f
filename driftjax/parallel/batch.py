"""Batches: pytrees whose arrays share a leading axis."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


def vmap_batch(function: Callable[..., Any]) -> Callable[..., Any]:
    """Map `function` of one entry over the leading axis of all arrays, in and out.

    A batch of one is not mapped: its branches stay branches, of which only one is taken, and loops are traced once.
    """

    def run(*batch: Any) -> Any:
        if batch_size(batch) > 1:
            return eqx.filter_vmap(function)(*batch)
        result = function(*jax.tree.map(lambda a: a[0] if eqx.is_array(a) else a, batch))
        return jax.tree.map(lambda a: jnp.asarray(a)[None] if eqx.is_array_like(a) else a, result)

    return run


def batch_size(batch: Any) -> int:
    """Return the length of the leading axis of the arrays."""
    return next(len(leaf) for leaf in jax.tree.leaves(batch) if eqx.is_array(leaf))


def concatenate(*batches: Any) -> Any:
    """Concatenate batches of one structure along the leading axis; leaves that are no arrays are those of the first."""

    def join(*leaves: Any) -> Any:
        if not eqx.is_array(leaves[0]):
            return leaves[0]
        return jnp.asarray(np.concatenate(leaves)) if isinstance(leaves[0], np.ndarray) else jnp.concatenate(leaves)

    return jax.tree.map(join, *batches)
