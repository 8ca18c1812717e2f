"""Log marginal likelihood of one output, with its gradient and average information in closed form."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import cho_solve

from driftjax.gp.kernel import KERNELS
from driftjax.gp.model import JITTER, Hyper, gram, squared_distances


class Derivatives(NamedTuple):
    """Log marginal likelihood and its derivatives by (log length scales, log amplitude, log noise), p = nf + 2."""

    value: Array
    gradient: Array  # (p,)
    information: Array  # (p, p), positive semi-definite: the mean of observed and expected information


class _Solved(NamedTuple):
    value: Array
    L: Array  # (M, M) Cholesky factor of the covariance
    alpha: Array  # (M,) its solution for the targets
    projected: Array | None  # (k, k) Cholesky factor of Q'KQ


def _solved(K: Array, y: Array, mask: Array, Q: Array | None) -> _Solved:
    """Return log p(y) for zero mean and covariance `K`, 0 where masked (Rasmussen and Williams 2006, Eq. 2.30)."""
    n = jnp.sum(mask).astype(y.dtype)
    L = jnp.linalg.cholesky(K)
    alpha = cho_solve((L, True), y)
    value, projected = -0.5 * y @ alpha - jnp.sum(jnp.log(jnp.diagonal(L))), None
    if Q is not None:
        present = jnp.sum(Q**2, axis=0)  # columns of Q are of length 1 or 0
        projected = jnp.linalg.cholesky(Q.T @ K @ Q + jnp.diag(1 - present))
        value, n = value + jnp.sum(jnp.log(jnp.diagonal(projected))), n - jnp.sum(present)
    return _Solved(value - 0.5 * n * jnp.log(2 * jnp.pi), L, alpha, projected)


def likelihood(kernel: str, hyper: Hyper, pairs: Array, y: Array, mask: Array, Q: Array | None = None) -> Array:
    """Return the log marginal likelihood of ONE output; `pairs` are `squared_differences(X)`, `y` (M,) scaled targets.

    Targets are 0 where masked. With the directions `Q` (M, k) of known effects it is the likelihood of the projected
    targets P y = y under the orthogonal GP: the determinant of its covariance in the other directions is that of
    K + noise P over that of Q'KQ.
    """
    return _solved(gram(kernel, hyper, pairs, mask, Q), y, mask, Q).value


def _weighted(S: Array, X: Array, V: Array) -> Array:
    """Return (M, nf): products with V (M,) of the matrices S_ab (x_a - x_b)^2, one per input of X (M, nf)."""
    columns = jnp.concatenate([V[:, None], V[:, None] * X, V[:, None] * X**2], axis=1)
    still, first, second = jnp.split(S @ columns, [1, 1 + X.shape[1]], axis=1)
    return X**2 * still - 2 * X * first + second


def derivatives(
    kernel: str, hyper: Hyper, X: Array, pairs: Array, y: Array, mask: Array, Q: Array | None = None
) -> Derivatives:
    """Return `likelihood` with its derivatives for centred scaled inputs `X` (M, nf), `pairs = squared_differences(X)`.

    With M = K^-1 - Q (Q'KQ)^-1 Q' the gradient is tr((alpha alpha' - M) dK) / 2 (Rasmussen and Williams 2006,
    Eq. 5.9) and the average information alpha' dK_i M dK_j alpha / 2 (Gilmour, Thompson and Cullis 1995, whose fixed
    effects are K Q). The dK of a length scale is never formed: it is a weight times (x_a - x_b)^2.
    """
    value, L, alpha, projected = _solved(gram(kernel, hyper, pairs, mask, Q), y, mask, Q)
    inverse = cho_solve((L, True), jnp.eye(y.size, dtype=y.dtype))
    if Q is not None and projected is not None:
        inverse = inverse - Q @ cho_solve((projected, True), Q.T)
    amplitude, noise = jnp.exp(2 * hyper.log_amplitude), jnp.exp(2 * hyper.log_noise)
    q = squared_distances(hyper, pairs)
    correlation, slope = jax.jvp(KERNELS[kernel], (q,), (jnp.ones_like(q),))
    both = mask[:, None] & mask[None, :]
    signal = jnp.where(both, amplitude * correlation, 0.0)
    signal = signal + jnp.diag(jnp.where(mask, JITTER * jnp.finfo(q.dtype).eps * amplitude, 0.0))
    weight = jnp.where(both, amplitude * slope, 0.0)
    rate = -2 * jnp.exp(-2 * hyper.log_lengthscale)
    project = (lambda v: v) if Q is None else (lambda v: v - Q @ (Q.T @ v))

    lengths = rate * _weighted(weight, X, alpha)  # dK alpha, for every length scale
    U = jnp.concatenate([lengths, 2 * (signal @ alpha)[:, None], 2 * noise * project(alpha)[:, None]], axis=1)
    ones = jnp.ones_like(alpha)
    traces = rate * jnp.sum(_weighted(weight * inverse, X, ones), axis=0)
    own = jnp.sum(jnp.where(mask, jnp.diagonal(inverse), 0.0))
    if Q is not None:
        own = own - jnp.sum(Q * (inverse @ Q))
    traces = jnp.concatenate([traces, jnp.array([2 * jnp.sum(signal * inverse), 2 * noise * own])])
    return Derivatives(value, 0.5 * (alpha @ U - traces), 0.5 * U.T @ inverse @ U)
