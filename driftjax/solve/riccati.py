"""Newton direction of an equality-constrained, stage-wise quadratic problem by a Riccati sweep."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

EIGENVALUE_FLOOR = 1e-4  # of the input Hessian scaled to unit diagonal [-]


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


def inverse_floored(R: Float[Array, "nu nu"]) -> Float[Array, "nu nu"]:
    """Inverse of a 1x1 or 2x2 symmetric matrix whose scaled eigenvalues are first raised to a positive floor."""
    scale = 1 / jnp.sqrt(jnp.maximum(jnp.abs(jnp.diag(R)), 1e-12))
    S = R * scale[:, None] * scale[None, :]
    if R.shape[0] == 1:
        return scale[None, :] ** 2 / jnp.maximum(S, EIGENVALUE_FLOOR)
    a, b, d = S[0, 0], S[0, 1], S[1, 1]
    lowest = 0.5 * (a + d) - jnp.sqrt(0.25 * (a - d) ** 2 + b**2)
    shift = jnp.maximum(0.0, EIGENVALUE_FLOOR - lowest)
    a, d = a + shift, d + shift
    inverse = jnp.array([[d, -b], [-b, a]]) / (a * d - b**2)
    return inverse * scale[:, None] * scale[None, :]


def newton_direction(q: Quadratic) -> tuple[Array, Array, Array]:
    """Step in states (N+1, nx) and inputs (N, nu), and the costates (N, nx) of x_1..x_N after a full step."""

    def backward(carry, stage):
        P, p = carry
        Hxx, Hux, Huu, hx, hu, A, B, c = stage
        PA, PB, g = P @ A, P @ B, P @ c + p
        S, R = Hux + B.T @ PA, Huu + B.T @ PB
        inverse = inverse_floored(R)
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
    return jnp.concatenate([dx0[None], dX]), dU, costates
