"""A function of one lane, for a batch of lanes."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


def each(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` in every lane: arrays in and out have a leading axis of lanes, which it does not see.

    A lane alone is not batched: its branches stay branches, of which only one is taken, and loops are traced once.
    """

    def run(*lanes: Any) -> Any:
        num = num_lanes(lanes)
        if num > 1:
            return eqx.filter_vmap(function)(*lanes)
        found = function(*jax.tree.map(lambda a: a[0] if eqx.is_array(a) else a, lanes))
        return jax.tree.map(lambda a: jnp.asarray(a)[None] if eqx.is_array_like(a) else a, found)

    return run


def num_lanes(lanes: Any) -> int:
    """Lanes of a batch: the length of the leading axis of its arrays."""
    return next(len(leaf) for leaf in jax.tree.leaves(lanes) if eqx.is_array(leaf))
