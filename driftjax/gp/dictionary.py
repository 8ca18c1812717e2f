"""Select the most informative rows of a data set, up to a given size."""

import jax
import jax.numpy as jnp
from jax import Array

from driftjax.gp.kernel import KERNELS
from driftjax.gp.model import data_scales


def select_dictionary(
    Z: Array,
    Y: Array,
    mask: Array,
    size: int,
    *,
    lengthscale: float | Array = 1.0,
    noise: float | Array = 0.1,
    kernel: str = "se",
) -> tuple[Array, Array, Array]:
    """Return at most `size` rows of `Z` (N, nf) and `Y` (N, D) where `mask`, and the mask of the rows returned.

    Greedy: the next row is the one with the largest conditional variance given the rows selected so far, of a unit GP
    with `lengthscale` in standard deviations of the inputs and `noise` per row: a pivoted Cholesky factorisation. The
    noise keeps the recursion well conditioned.
    """
    N = Z.shape[0]
    mask = mask.astype(bool)
    X = jnp.where(mask[:, None], Z, 0.0) / data_scales(Z, Y, mask)[0] / lengthscale
    k = jax.vmap(lambda p, q: KERNELS[kernel](jnp.sum((p - q) ** 2)), in_axes=(0, None))

    def keep(step, carry):
        factor, variance, free, rows, valid = carry
        row = jnp.argmax(jnp.where(free, variance, -jnp.inf))
        column = k(X, X[row]) - factor @ factor[row]
        column = column / jnp.sqrt(variance[row] + noise**2)
        return (
            factor.at[:, step].set(column),
            jnp.maximum(variance - column**2, 0.0),
            free.at[row].set(False),
            rows.at[step].set(row),
            valid.at[step].set(free[row]),
        )

    start = (jnp.zeros((N, size), X.dtype), jnp.ones(N, X.dtype), mask, jnp.zeros(size, int), jnp.zeros(size, bool))
    _, _, _, rows, valid = jax.lax.fori_loop(0, size, keep, start)
    return jnp.where(valid[:, None], Z[rows], 0.0), jnp.where(valid[:, None], Y[rows], 0.0), valid
