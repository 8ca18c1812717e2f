"""Mean of a GP with first and second derivatives at many points of a batch of GPs, by matrix products."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.gp.kernel import KERNELS
from driftjax.gp.model import FADE_LENGTH, GP
from driftjax.parallel import vmap_batch

PROPORTIONAL = {"se": -0.5}  # kernels whose derivative in q is so many times themselves: one product instead of three


class Expansion(NamedTuple):
    """D functions of `nf` inputs to second order, each entry (D, ...) over the points."""

    value: Array
    gradient: list[Array]
    hessian: list[Array]  # entries (i, j), i <= j, row by row


class _Sums(NamedTuple):
    """Sums over the data m of amount_m times the kernel, or a derivative of it in q, times products of the inputs."""

    value: Float[Array, "*batch P"]
    S: Float[Array, "*batch 1+nf P"]  # first derivative: times 1, a_i
    R: Float[Array, "*batch 1+nf+pairs P"]  # second derivative: times 1, a_i, a_i a_j


def pairs(nf: int) -> list[tuple[int, int]]:
    """Return the index pairs of a symmetric matrix in the order of `Expansion.hessian`."""
    return [(i, j) for i in range(nf) for j in range(i, nf)]


def expansions(gp: GP, z: Sequence[Array]) -> tuple[Expansion, Expansion]:
    """Return the expansions of the mean (D outputs) and of the nearness of data, as in `GP.mean` and `GP.fade`.

    Leaves of `gp` have a leading batch axis, of size 1 if shared; `z` are the inputs, arrays (..., batch). All points
    of a batch entry go through one matrix product, or all points of the batch if the GP is shared.
    """
    inverse = jnp.exp(-gp.hyper.log_lengthscale) / gp.scale[:, None]  # (batch, D, nf)
    size = jnp.exp(2 * gp.hyper.log_amplitude) * gp.output_scale
    amounts = size[:, :, None] * jnp.where(gp.mask[:, None], gp.alpha, 0.0)
    mean = _sum_of_kernels(gp.kernel, gp.Z, inverse, amounts, z)
    near = _sum_of_kernels("se", gp.Z, 1 / (FADE_LENGTH * gp.scale)[:, None], gp.mask[:, None].astype(z[0].dtype), z)
    return mean, near


def _sum_of_kernels(kernel: str, Z: Array, inverse: Array, amounts: Array, z: Sequence[Array]) -> Expansion:
    """Return the sums of amounts_m k(|inverse (z - Z_m)|^2), per output.

    Derivatives are moments of the data about the point; as moments about their centre they are one product of matrices
    for all points. One output after the other: products of a batch of matrices take several times longer on a CPU.
    """
    shape, nf = z[0].shape, len(z)
    batch, centre = len(Z), jnp.mean(Z, axis=1)
    points = jnp.stack(z).reshape(nf, -1, batch).T  # (batch, P, nf)
    back = lambda a: jnp.moveaxis(a, 0, -1).reshape(*a.shape[1:-1], *shape)
    along = lambda a: jnp.moveaxis(a, 0, -1).reshape(*a.shape[1:], *[1] * (len(shape) - 1), batch)
    sums = vmap_batch(functools.partial(_sums, kernel))
    sums_of_outputs = [
        jax.tree.map(back, sums(Z, centre, inverse[:, k], amounts[:, k], points)) for k in range(inverse.shape[1])
    ]
    value, S, R = (jnp.stack(parts) for parts in zip(*sums_of_outputs, strict=True))
    over = [along(inverse[:, :, i]) for i in range(nf)]
    b = [(zi - along(centre[:, i])) * w for i, (zi, w) in enumerate(zip(z, over, strict=True))]
    gradient = [2 * w * (bi * S[:, 0] - S[:, 1 + i]) for i, (bi, w) in enumerate(zip(b, over, strict=True))]
    bend = [
        4 * (b[i] * b[j] * R[:, 0] - b[i] * R[:, 1 + j] - b[j] * R[:, 1 + i] + R[:, 1 + nf + at])
        for at, (i, j) in enumerate(pairs(nf))
    ]
    own = [2 * S[:, 0] if i == j else 0.0 for i, j in pairs(nf)]
    hessian = [over[i] * over[j] * (h + d) for (i, j), h, d in zip(pairs(nf), bend, own, strict=True)]
    return Expansion(value, gradient, hessian)


def _sums(kernel: str, Z: Array, centre: Array, inverse: Array, amounts: Array, z: Array) -> _Sums:
    """Return the sums for one output and one batch entry: Z (M, nf), z (P, nf)."""
    nf = len(centre)
    a, b = ((Z - centre) * inverse).T, ((z - centre) * inverse).T  # (nf, M), (nf, P)
    products = jnp.stack([a[i] * a[j] for i, j in pairs(nf)])
    moments = jnp.concatenate([jnp.ones_like(a[:1]), a, products]) * amounts
    if kernel in PROPORTIONAL:
        rate = PROPORTIONAL[kernel]
        T = moments @ KERNELS[kernel](_squares(a, b))
        return _Sums(T[0], rate * T[: 1 + nf], rate**2 * T)
    # by differences: kernels with a kink in q would magnify what rounding leaves of a product
    q = functools.reduce(jnp.add, ((b[i][None] - a[i][:, None]) ** 2 for i in range(nf)))  # (M, P)
    slope = lambda q: jax.jvp(KERNELS[kernel], (q,), (jnp.ones_like(q),))[1]
    first, second = jax.jvp(slope, (q,), (jnp.ones_like(q),))
    return _Sums(amounts @ KERNELS[kernel](q), moments[: 1 + nf] @ first, moments @ second)


def _squares(a: Float[Array, "nf M"], b: Float[Array, "nf P"]) -> Float[Array, "M P"]:
    """Return the squared distances of all columns by one matrix product; absolute errors scale with the largest."""
    square = lambda c: jnp.sum(c**2, axis=0)[None]
    rows = jnp.concatenate([-2 * a, square(a), jnp.ones_like(a[:1])])
    return rows.T @ jnp.concatenate([b, jnp.ones_like(b[:1]), square(b)])
