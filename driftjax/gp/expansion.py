"""The mean of a GP with first and second derivatives at many points at once, by matrix products."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.gp.kernel import KERNELS
from driftjax.gp.model import FADE_LENGTH, GP

PROPORTIONAL = {"se": -0.5}  # kernels whose derivative in q is so many times themselves: one product instead of three


class Expansion(NamedTuple):
    """Functions of `nf` inputs to second order at P points."""

    value: Float[Array, "D P"]
    gradient: Float[Array, "D nf P"]
    hessian: Float[Array, "D pairs P"]  # entries (i, j), i <= j, row by row


def pairs(nf: int) -> list[tuple[int, int]]:
    """Entries of a symmetric matrix in the order of `Expansion.hessian`."""
    return [(i, j) for i in range(nf) for j in range(i, nf)]


def firsts(a: Float[Array, "nf ..."]) -> Float[Array, "pairs ..."]:
    """Entry i of each of the `pairs`."""
    return jnp.concatenate([jnp.broadcast_to(a[i], (len(a) - i, *a.shape[1:])) for i in range(len(a))])


def seconds(a: Float[Array, "nf ..."]) -> Float[Array, "pairs ..."]:
    """Entry j of each of the `pairs`."""
    return jnp.concatenate([a[i:] for i in range(len(a))])


def expansions(gp: GP, z: Float[Array, "P nf"]) -> tuple[Expansion, Expansion]:
    """Mean (D outputs) and nearness (one) at the points `z`, as `GP.mean` and `GP.fade` have them."""
    inverse = jnp.exp(-gp.hyper.log_lengthscale) / gp.scale
    size = jnp.exp(2 * gp.hyper.log_amplitude) * gp.output_scale
    amounts = size[:, None] * jnp.where(gp.mask, gp.alpha, 0.0)
    mean = jax.vmap(_sum_of_kernels, (None, None, 0, 0, None))(gp.kernel, gp.Z, inverse, amounts, z)
    near = _sum_of_kernels("se", gp.Z, 1 / (FADE_LENGTH * gp.scale), gp.mask.astype(z.dtype), z)
    return mean, jax.tree.map(lambda a: a[None], near)


def _sum_of_kernels(kernel: str, Z: Array, inverse: Array, amounts: Array, z: Array) -> Expansion:
    """Sum of amounts_m k(|inverse (z - Z_m)|^2) at all `z`.

    Derivatives are moments of the data about the point; as moments about their centre they are one product of matrices
    for all points.
    """
    nf, (i, j) = Z.shape[1], (firsts, seconds)
    centre = jnp.mean(Z, axis=0)
    a, b = ((Z - centre) * inverse).T, ((z - centre) * inverse).T  # (nf, M), (nf, P)
    q = functools.reduce(jnp.add, ((b[i][None] - a[i][:, None]) ** 2 for i in range(nf)))  # (M, P)
    one = jnp.ones_like(a[:1])
    moments = jnp.concatenate([one, a, i(a) * j(a)]) * amounts
    if kernel in PROPORTIONAL:
        rate = PROPORTIONAL[kernel]
        T = moments @ KERNELS[kernel](q)
        value, S, R = T[0], rate * T[: 1 + nf], rate**2 * T
    else:
        slope = lambda q: jax.jvp(KERNELS[kernel], (q,), (jnp.ones_like(q),))[1]
        first, second = jax.jvp(slope, (q,), (jnp.ones_like(q),))
        value, S, R = amounts @ KERNELS[kernel](q), moments[: 1 + nf] @ first, moments @ second
    along = R[1 : 1 + nf]
    bend = 4 * (i(b) * j(b) * R[0] - i(b) * j(along) - j(b) * i(along) + R[1 + nf :])
    own = jnp.asarray([2.0 if k == l else 0.0 for k, l in pairs(nf)])[:, None] * S[0]
    gradient = 2 * inverse[:, None] * (b * S[0] - S[1:])
    return Expansion(value, gradient, (i(inverse) * j(inverse))[:, None] * (bend + own))
