"""Excite steering and drive in the corner, so that a lap's inputs do not only follow its states."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

CYCLES = jnp.array([[3.0, 5.0, 8.0], [4.0, 6.0, 9.0]])  # of steering and drive over the corner: whole, none shared
SIGNS = jnp.array([1.0, -1.0, 1.0])  # keep the peaks of the sines apart


def corner_excitation(share: Float[Array, "..."]) -> Float[Array, "... 2"]:
    """Return steering and drive at a `share` of the corner, each within -1 and 1; 0 at both ends and beyond them."""
    waves = jnp.sin(2 * jnp.pi * CYCLES * share[..., None, None])
    inside = (share > 0) & (share < 1)
    return jnp.where(inside[..., None], jnp.sum(SIGNS * waves, axis=-1) / len(SIGNS), 0.0)
