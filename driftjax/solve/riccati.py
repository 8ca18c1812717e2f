"""Newton direction of an equality-constrained, stage-wise quadratic problem by a Riccati sweep."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

TINY = 1e-30  # keeps a matrix of zeros finite
EIGENVALUE_FLOOR = 1e-8  # added to the eigenvalues of the input Hessian scaled to unit diagonal [-]


class Quadratic(NamedTuple):
    """minimise sum 1/2 d'Hd + h'd, d = (dx, du), subject to dx+ = A dx + B du + c and dx_0 = 0."""

    Hxx: Float[Array, "N nx nx"]
    Hux: Float[Array, "N nu nx"]
    Huu: Float[Array, "N nu nu"]
    hx: Float[Array, "N nx"]
    hu: Float[Array, "N nu"]
    A: Float[Array, "N nx nx"]
    B: Float[Array, "N nx nu"]
    c: Float[Array, "N nx"]
    HN: Float[Array, "nx nx"]
    hN: Float[Array, " nx"]


def inverse_absolute(R: Float[Array, "nu nu"]) -> Float[Array, "nu nu"]:
    """Invert a 1x1 or 2x2 symmetric matrix after replacing its eigenvalues by their absolute values.

    Along a direction of negative curvature the step is then as long as the curvature is weak, not unbounded as it
    would be with a small floor (Dauphin et al. 2014); where the matrix is positive nothing changes.
    """
    scale = 1 / jnp.sqrt(jnp.maximum(jnp.abs(jnp.diag(R)), 1e-12))
    S = R * scale[:, None] * scale[None, :]
    if R.shape[0] == 1:
        return scale[None, :] ** 2 / jnp.maximum(jnp.abs(S), EIGENVALUE_FLOOR)
    determinant = jnp.abs(S[0, 0] * S[1, 1] - S[0, 1] ** 2)
    size = jnp.sqrt(jnp.maximum(jnp.sum(S**2) + 2 * determinant, TINY))  # sum of the absolute eigenvalues
    a, b, d = S[0, 0] ** 2 + S[0, 1] ** 2, S[0, 1] * (S[0, 0] + S[1, 1]), S[1, 1] ** 2 + S[0, 1] ** 2
    a, b, d = (a + determinant) / size + EIGENVALUE_FLOOR, b / size, (d + determinant) / size + EIGENVALUE_FLOOR
    inverse = jnp.array([[d, -b], [-b, a]]) / (a * d - b**2)
    return inverse * scale[:, None] * scale[None, :]


class Direction(NamedTuple):
    """Newton step and the affine policy du = k + K dx behind it."""

    dX: Float[Array, "N+1 nx"]
    dU: Float[Array, "N nu"]
    costates: Float[Array, "N nx"]  # of x_1..x_N after the full step
    K: Float[Array, "N nu nx"]
    k: Float[Array, "N nu"]


def newton_direction(q: Quadratic) -> Direction:
    """Return the minimiser of `q`, with input blocks made positive definite where necessary."""

    def backward(carry, stage):
        P, p = carry
        Hxx, Hux, Huu, hx, hu, A, B, c = stage
        PA, PB, g = P @ A, P @ B, P @ c + p
        S, R = Hux + B.T @ PA, Huu + B.T @ PB
        inverse = inverse_absolute(R)
        K, k = -inverse @ S, -inverse @ (hu + B.T @ g)
        Pk = Hxx + A.T @ PA + S.T @ K
        return (0.5 * (Pk + Pk.T), hx + A.T @ g + S.T @ k), (K, k, P, p)

    _, (K, k, P, p) = jax.lax.scan(backward, (q.HN, q.hN), q[:8], reverse=True)

    def forward(dx, stage):
        A, B, c, K, k, P, p = stage
        du = K @ dx + k
        dx_next = A @ dx + B @ du + c
        return dx_next, (dx_next, du, P @ dx_next + p)

    dx0 = jnp.zeros_like(q.hN)
    _, (dX, dU, costates) = jax.lax.scan(forward, dx0, (q.A, q.B, q.c, K, k, P, p))
    return Direction(jnp.concatenate([dx0[None], dX]), dU, costates, K, k)
