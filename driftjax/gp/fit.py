"""Hyper-parameters by maximum marginal likelihood, with several starts per output."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from driftjax.core import RESULTS, require
from driftjax.core.bounded import Minimum
from driftjax.core.bounded_newton import minimise_batch
from driftjax.environment import require_float64
from driftjax.gp.kernel import KERNELS
from driftjax.gp.likelihood import derivatives
from driftjax.gp.model import GP, Hyper, condition, data_scales, squared_differences
from driftjax.gp.orthogonal import orthonormal_basis, project_out

# Bounds in scaled inputs and outputs: (length scale, amplitude, noise), all standard deviations.
LOWER = (0.1, 0.05, 1e-3)
UPPER = (20.0, 20.0, 2.0)
START_LOWER = (0.3, 0.5, 0.01)  # starts are drawn log-uniformly from here
START_UPPER = (5.0, 2.0, 0.5)

SHARE = 3  # of so many rows one is in the subset on which all starts are tried,
FEWEST = 50  # where it has at least so many rows; the best of each output goes on with all rows
ROUGH, FINE = 1e-2, 2e-3  # tolerances of the projected gradient per row, on the subset and on all rows


class FitResult(eqx.Module):
    """A fitted GP and the diagnostics of the fit, per output."""

    gp: GP
    log_marginal_likelihood: Array  # (D,) of the best start, on the rows used for the fit, scaled outputs
    error: Array  # (D,) largest projected gradient per data row at the best start
    num_steps: Array  # (D,) iterations of the best start, on all rows of the fit
    result: RESULTS  # (D,)


def _vector(values: tuple[float | Array, float, float], nf: int) -> Array:
    length, amplitude, noise = values
    return jnp.log(jnp.array([length] * nf + [amplitude, noise], jnp.result_type(float)))


def _hyper(x: Array) -> Hyper:
    return Hyper(x[..., :-2], x[..., -2], x[..., -1])


def _subset(mask: Array, size: int, key: Array, *columns: Array) -> tuple[Array, ...]:
    """Return at most `size` random rows of `columns`, then of `mask`, preferring rows with data."""
    if mask.shape[0] <= size:
        return *columns, mask
    score = jnp.where(mask, jax.random.uniform(key, mask.shape), -1.0)
    rows = jax.lax.top_k(score, size)[1]
    return *(column[rows] for column in columns), mask[rows]


def _starts(D: int, nf: int, num_restarts: int, previous: GP | None, key: Array) -> Array:
    """Return the starts (D, restarts, nf + 2): the previous fit, or unit scales, then random ones."""
    share = jax.random.uniform(key, (D, num_restarts, nf + 2))
    low, high = _vector(START_LOWER, nf), _vector(START_UPPER, nf)
    first = jnp.broadcast_to(_vector((1.0, 1.0, 0.1), nf), (D, nf + 2))
    if previous is not None:
        h = previous.hyper
        first = jnp.concatenate([h.log_lengthscale, h.log_amplitude[:, None], h.log_noise[:, None]], axis=1)
    return (low + share * (high - low)).at[:, 0].set(first)


def _best(starts: Array, X: Array, T: Array, *rest: Array, kernel: str, **options: Any) -> Minimum:
    """Return the best optimum per output from `starts` (D, restarts, nf + 2), on scaled rows `X`, `T`, `basis`, `mask`.

    The fits run in sequence: in a batch each would wait for the slowest, and batched factorisations are slow on a CPU.
    """
    *basis, mask = rest
    held = [orthonormal_basis(J, mask) for J in basis]  # of these rows, to which T is made orthogonal
    T = project_out(T, basis[0], mask) if basis else T
    rows = jnp.maximum(jnp.sum(mask), 1)
    X = jnp.where(mask[:, None], X - jnp.sum(jnp.where(mask[:, None], X, 0.0), axis=0) / rows, 0.0)
    pairs = squared_differences(X)

    def output(data: tuple[Array, ...]) -> Minimum:
        starts, y, *Q = data

        def evaluate(x: Array) -> tuple[Array, Array, Array]:
            value, gradient, information = derivatives(kernel, _hyper(x), X, pairs, y, mask, *Q)
            return -value / rows, -gradient / rows, information / rows  # per row: one tolerance serves all sizes

        ends = jax.lax.map(lambda x: minimise_batch(evaluate, x, **options), starts)
        best = jnp.argmin(jnp.where(jnp.isfinite(ends.value), ends.value, jnp.inf))
        return jax.tree.map(lambda leaf: leaf[best], ends)

    return jax.lax.map(output, (starts, T.T, *held))


def fit_gp(Z: ArrayLike, Y: ArrayLike, *, kernel: str = "se", num_restarts: int = 4, seed: int = 0) -> FitResult:
    """Fit an exact GP to inputs `Z` (M, nf) and targets `Y` (M,) or (M, D) by maximum marginal likelihood.

    Raw units in and out; zero prior mean; one length scale per input (`kernel`: se or matern52, see `KERNELS`).
    `result.gp` has `mean`, `variance` and `gradient` at one input (nf,): `vmap` them for many. Raises `BadInput`
    for shapes that do not fit and values that are not finite; `result.result` says how each output's fit ended.
    """
    require_float64()
    Z, Y = np.asarray(Z, float), np.asarray(Y, float)
    Y = Y[:, None] if Y.ndim == 1 else Y
    fits = Z.ndim == 2 and Y.ndim == 2 and len(Z) == len(Y)
    require(fits, f"Z has shape {Z.shape} and Y {Y.shape}; give (rows, inputs) and (rows, outputs).")
    require(bool(np.isfinite(Z).all() and np.isfinite(Y).all()), "Z or Y holds values that are not finite; drop them.")
    require(kernel in KERNELS, f"kernel is '{kernel}'; choose one of {', '.join(KERNELS)}.")
    rows, key = jnp.ones(len(Z), bool), jax.random.key(seed)
    return fit_masked(
        jnp.asarray(Z), jnp.asarray(Y), rows, num_restarts=num_restarts, num_fit=len(Z), kernel=kernel, key=key
    )


@eqx.filter_jit
def fit_masked(
    Z: Array,
    Y: Array,
    mask: Array,
    *,
    num_restarts: int = 4,
    max_iterations: int = 30,
    num_fit: int = 150,
    kernel: str = "se",
    shortest: float | Array = LOWER[0],
    previous: GP | None = None,
    basis: Array | None = None,
    key: Array,
) -> FitResult:
    """Return the GP of inputs `Z` (M, nf) and targets `Y` (M, D), conditioned on all rows where `mask`.

    Hyper-parameters maximise the marginal likelihood of at most `num_fit` random rows; a warm start from `previous`
    (an earlier fit of the same shapes) saves iterations. `shortest` bounds the length scales from below, in standard
    deviations of the inputs: faster variation is attributed to noise. `basis` (M, D, k) holds the directions of known
    effects, to which the GP is orthogonal at its data. `result` is `non_finite` if every start failed.
    """
    key_rows, key_few, key_starts = jax.random.split(key, 3)
    mask = mask.astype(bool)
    Z, Y = jnp.where(mask[:, None], Z, 0.0), jnp.where(mask[:, None], Y, 0.0)
    if basis is not None:
        Y = project_out(Y, basis, mask)
    scale, output_scale = data_scales(Z, Y, mask)
    columns = (Z / scale, Y / output_scale, *([] if basis is None else [basis]))
    columns = _subset(mask, num_fit, key_rows, *columns)
    low, high = _vector((shortest, *LOWER[1:]), Z.shape[1]), _vector(UPPER, Z.shape[1])
    options = {"kernel": kernel, "lower": low, "upper": high, "max_iterations": max_iterations}
    starts = _starts(Y.shape[1], Z.shape[1], num_restarts, previous, key_starts)
    few = -(-min(num_fit, len(mask)) // SHARE)
    if few >= FEWEST:
        rough = _best(starts, *_subset(columns[-1], few, key_few, *columns[:-1]), tolerance=ROUGH, **options)
        starts = rough.x[:, None]
    best = _best(starts, *columns, tolerance=FINE, **options)
    rows = jnp.maximum(jnp.sum(columns[-1]), 1)
    gp = condition(Z, Y, mask, _hyper(best.x), scale, output_scale, kernel, basis)
    return FitResult(gp, -best.value * rows, best.error, best.num_steps, best.result)
