"""Hyper-parameters by maximum marginal likelihood, several starts per output."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.core import RESULTS
from driftjax.gp.likelihood import log_marginal_likelihood
from driftjax.gp.model import GP, Hyper, condition, gram, scales, squares
from driftjax.gp.optimise import minimise
from driftjax.gp.orthogonal import directions, unclaimed

# Bounds in scaled inputs and outputs: (length scale, amplitude, noise), all standard deviations.
LOWER = (0.1, 0.05, 1e-3)
UPPER = (20.0, 20.0, 2.0)
START_LOWER = (0.3, 0.5, 0.01)  # starts are drawn log-uniformly from here
START_UPPER = (5.0, 2.0, 0.5)


class FitResult(eqx.Module):
    """A fitted GP and how the fit went, per output."""

    gp: GP
    log_marginal_likelihood: Array  # (D,) of the best start, on the rows used for the fit, scaled outputs
    error: Array  # (D,) largest projected gradient per data row at the best start
    num_steps: Array  # (D,) L-BFGS-B iterations of the best start
    result: RESULTS  # (D,)


def _vector(values: tuple[float, float, float], nf: int) -> Array:
    length, amplitude, noise = values
    return jnp.log(jnp.array([length] * nf + [amplitude, noise], jnp.result_type(float)))


def _hyper(x: Array) -> Hyper:
    return Hyper(x[..., :-2], x[..., -2], x[..., -1])


def likelihood(kernel: str, hyper: Hyper, pairs: Array, y: Array, mask: Array, Q: Array | None = None) -> Array:
    """Log marginal likelihood of ONE output from `squares(X)` and scaled targets `y` (M,), 0 where masked.

    With the directions `Q` (M, k) of known causes it is that of what they leave, P y = y, under the orthogonal GP: the
    determinant of its covariance in the other directions is that of K + noise P over that of Q'KQ.
    """
    n = jnp.sum(mask).astype(y.dtype)
    if Q is None:
        return log_marginal_likelihood(gram(kernel, hyper, pairs, mask), y, n)
    K, present = gram(kernel, hyper, pairs, mask, Q), jnp.sum(Q**2, axis=0)  # columns of Q are of length 1 or 0
    held = jnp.linalg.cholesky(Q.T @ K @ Q + jnp.diag(1 - present))
    return log_marginal_likelihood(K, y, n - jnp.sum(present)) + jnp.sum(jnp.log(jnp.diagonal(held)))


def _subset(mask: Array, size: int, key: Array, *columns: Array) -> tuple[Array, ...]:
    """At most `size` random rows of `columns` and then `mask`, data first."""
    if mask.shape[0] <= size:
        return *columns, mask
    score = jnp.where(mask, jax.random.uniform(key, mask.shape), -1.0)
    rows = jax.lax.top_k(score, size)[1]
    return *(column[rows] for column in columns), mask[rows]


def _starts(D: int, nf: int, num_restarts: int, previous: GP | None, key: Array) -> Array:
    """(D, restarts, nf + 2): the previous fit, or unit scales; then random ones."""
    share = jax.random.uniform(key, (D, num_restarts, nf + 2))
    low, high = _vector(START_LOWER, nf), _vector(START_UPPER, nf)
    first = jnp.broadcast_to(_vector((1.0, 1.0, 0.1), nf), (D, nf + 2))
    if previous is not None:
        h = previous.hyper
        first = jnp.concatenate([h.log_lengthscale, h.log_amplitude[:, None], h.log_noise[:, None]], axis=1)
    return (low + share * (high - low)).at[:, 0].set(first)


@eqx.filter_jit
def fit(
    Z: Array,
    Y: Array,
    mask: Array,
    *,
    num_restarts: int = 4,
    max_iterations: int = 30,
    num_fit: int = 150,
    kernel: str = "se",
    shortest: float = LOWER[0],
    previous: GP | None = None,
    basis: Array | None = None,
    key: Array,
) -> FitResult:
    """GP of inputs `Z` (M, nf) and targets `Y` (M, D) in rows where `mask`; all M rows are conditioned on.

    Hyper-parameters maximise the marginal likelihood of at most `num_fit` random rows; a start at `previous`
    (fitted earlier, same shapes) saves iterations. `shortest` bounds the length scales from below, in standard
    deviations of the inputs: what varies faster is then left to the noise. `basis` (M, D, k) holds the directions of
    known causes, to which the GP is orthogonal at its data. `result` is `non_finite` where every start failed.
    """
    key_rows, key_starts = jax.random.split(key)
    mask = mask.astype(bool)
    Z, Y = jnp.where(mask[:, None], Z, 0.0), jnp.where(mask[:, None], Y, 0.0)
    if basis is not None:
        Y = unclaimed(Y, basis, mask)
    scale, output_scale = scales(Z, Y, mask)
    columns = (Z / scale, Y / output_scale, *([] if basis is None else [basis]))
    X, T, *part, used = _subset(mask, num_fit, key_rows, *columns)
    held = [directions(J, used) for J in part]  # of these rows, to which T is made orthogonal
    T = unclaimed(T, part[0], used) if part else T
    pairs = squares(X)
    nf, D = Z.shape[1], Y.shape[1]
    rows = jnp.maximum(jnp.sum(used), 1)

    low = _vector((shortest, *LOWER[1:]), nf)  # minimise starts inside the bounds

    def objective(x: Array, *data: Array) -> Array:
        y, *Q = data
        return -likelihood(kernel, _hyper(x), pairs, y, used, *Q) / rows  # per row: one tolerance serves all sizes

    def start(x: Array, *data: Array):
        return minimise(objective, x, low, _vector(UPPER, nf), *data, max_iterations=max_iterations)

    def output(starts: Array, *data: Array):
        ends = jax.vmap(lambda x: start(x, *data))(starts)
        best = jnp.argmin(jnp.where(jnp.isfinite(ends.value), ends.value, jnp.inf))
        return jax.tree.map(lambda leaf: leaf[best], ends)

    best = jax.vmap(output)(_starts(D, nf, num_restarts, previous, key_starts), T.T, *held)
    gp = condition(Z, Y, mask, _hyper(best.x), scale, output_scale, kernel, basis)
    return FitResult(gp, -best.value * rows, best.error, best.num_steps, best.result)
