"""Log marginal likelihood with its analytic gradient."""

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import cho_solve, solve_triangular


def _value(K: Array, y: Array, n: Array) -> tuple[Array, Array, Array]:
    L = jnp.linalg.cholesky(K)
    alpha = cho_solve((L, True), y)
    logdet = jnp.sum(jnp.log(jnp.diagonal(L)))
    return -0.5 * jnp.dot(y, alpha) - logdet - 0.5 * n * jnp.log(2 * jnp.pi), L, alpha


def _log_marginal_likelihood(K: Array, y: Array, n: Array) -> Array:
    """log p(y) of `n` unmasked zero-mean targets with covariance `K` (Rasmussen and Williams 2006, Eq. 2.30).

    The gradient is (alpha alpha^T - K^-1) / 2 (Eq. 5.9): one inverse, where autodiff through the Cholesky
    factorisation takes several products more. Masked rows are rows of the identity with target 0.
    """
    return _value(K, y, n)[0]


def _forward(K, y, n):
    value, L, alpha = _value(K, y, n)
    inverse_L = solve_triangular(L, jnp.eye(y.size, dtype=y.dtype), lower=True)
    return value, (inverse_L, alpha, n)


def _backward(saved, g):
    inverse_L, alpha, n = saved
    dK = 0.5 * (jnp.outer(alpha, alpha) - inverse_L.T @ inverse_L)
    return g * dK, -g * alpha, jnp.zeros_like(n)


log_marginal_likelihood = jax.custom_vjp(_log_marginal_likelihood)
log_marginal_likelihood.defvjp(_forward, _backward)
