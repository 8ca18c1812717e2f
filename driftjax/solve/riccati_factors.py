"""Factorise a stage-wise Newton system by a Riccati recursion, and solve it for several right-hand sides."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float


class NewtonMatrices(NamedTuple):
    """Matrices of: minimise sum 1/2 d'Hd + h'd, d = (dx, du), subject to dx+ = A dx + B du + c, dx_0 = 0."""

    Hxx: Float[Array, "N nx nx"]
    Hux: Float[Array, "N nu nx"]
    Huu: Float[Array, "N nu nu"]
    A: Float[Array, "N nx nx"]
    B: Float[Array, "N nx nu"]
    HN: Float[Array, "nx nx"]


class RiccatiFactors(NamedTuple):
    """Feedback gains, inverse input Hessians and Hessians of the cost-to-go of x_1..x_N."""

    K: Float[Array, "N nu nx"]
    inverse: Float[Array, "N nu nu"]
    P: Float[Array, "N nx nx"]
    convex: Bool[Array, ""]  # whether all input Hessians are positive definite, so that a minimiser exists


def _inverse(R: Float[Array, "nu nu"]) -> tuple[Array, Array]:
    """Return the inverse of a symmetric 1x1 or 2x2 matrix, and whether it is positive definite."""
    if R.shape[0] == 1:
        return 1 / R, R[0, 0] > 0
    a, b, d = R[0, 0], R[0, 1], R[1, 1]
    determinant = a * d - b * b
    positive = (a > 0) & (determinant > 1e-14 * a * jnp.abs(d))
    safe = jnp.where(positive, determinant, 1.0)
    return jnp.stack([jnp.stack([d, -b]), jnp.stack([-b, a])]) / safe, positive


def factorise(q: NewtonMatrices) -> RiccatiFactors:
    """Run the backward recursion. The reduced Hessian is positive definite exactly where all input blocks are."""

    def backward(P, stage):
        Hxx, Hux, Huu, A, B = stage
        PA, PB = P @ A, P @ B
        S, R = Hux + B.T @ PA, Huu + B.T @ PB
        inverse, positive = _inverse(0.5 * (R + R.T))
        K = -inverse @ S
        before = Hxx + A.T @ PA + S.T @ K
        return 0.5 * (before + before.T), (K, inverse, P, positive)

    _, (K, inverse, P, positive) = lax.scan(backward, q.HN, q[:5], reverse=True)
    return RiccatiFactors(K, inverse, P, jnp.all(positive) & jnp.all(jnp.isfinite(K)))


def solve_factored(factors: RiccatiFactors, A: Array, B: Array, c: Array, hx: Array, hu: Array, hN: Array):
    """Solve for one right-hand side.

    Returns the step in states (N+1, nx) and inputs (N, nu), and the costates (N, nx) of x_1..x_N after it.
    """

    def backward(p, stage):
        K, inverse, P, A, B, c, hx, hu = stage
        g = P @ c + p
        k = -inverse @ (hu + B.T @ g)
        return hx + A.T @ g + K.T @ (hu + B.T @ g), (k, p)

    _, (k, p) = lax.scan(backward, hN, (factors.K, factors.inverse, factors.P, A, B, c, hx, hu), reverse=True)

    def forward(dx, stage):
        K, k, P, p, A, B, c = stage
        du = K @ dx + k
        after = A @ dx + B @ du + c
        return after, (after, du, P @ after + p)

    start = jnp.zeros_like(hN)
    _, (dX, dU, costates) = lax.scan(forward, start, (factors.K, k, factors.P, p, A, B, c))
    return jnp.concatenate([start[None], dX]), dU, costates
