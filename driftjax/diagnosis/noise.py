"""Estimate measurement and process noise from the data, by the restricted likelihood of the innovations.

The noise is what no effect of the catalogue explains: the parameters of all of them are profiled out to first order,
so that missing physics is not mistaken for noise (Harville 1977, Eq. 3.1; Kristensen, Madsen and Jorgensen 2004 for
process noise as the measure of a model's defect).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core.bounded import Minimum, minimise_within
from driftjax.diagnosis.observer import Gains, Steps, innovations_with_gains, kalman_gains, propagate_derivatives
from driftjax.parallel import call

PRIOR = 3.0  # standard deviation of a parameter before any data, in typical sizes
FIRST_DISTURBANCE = 0.5  # disturbance assumed before any is known, in measurement noise per second
UNSEEN = 10.0  # bound of a disturbance, over the first one, whose own channel does not tell it
UNMEASURED = (
    0.15  # standard deviation assumed of a channel without any measurement: of a sideslip, half at the start [rad]
)
CORRELATION = 0.3  # and its correlation time [s]
SEARCHED = 8000  # samples that it is estimated from
ITERATIONS = 40  # of the search, at most
LOG_SCALES = np.array(
    [1.0, 1.0, 1.0, 0.3, 0.3, 0.3, 0.2]
)  # how sharply data fix each log noise: nearly halves the search
GRADIENT_TOLERANCE = 1e-4  # largest projected gradient left per measurement


class Noise(NamedTuple):
    """Estimated noise."""

    sigma: np.ndarray  # (3,) standard deviation of the measured V, beta, r
    disturbance: np.ndarray  # (3,) standard deviation of the rates of V, beta, r
    correlation: float  # correlation time of the disturbances [s]

    def as_vector(self) -> np.ndarray:
        """Return all parameters as one vector (7,)."""
        return np.concatenate([self.sigma, self.disturbance, [self.correlation]])


def measurement_noise(y: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return an initial guess (c,) from third differences of y (P, T, c), robust to outliers."""
    d = np.diff(y, n=3, axis=1)
    whole = np.min([valid[:, k : k + d.shape[1]] for k in range(4)], axis=0) > 0
    spread = [robust_deviation(d[..., i][whole[..., i]]) for i in range(y.shape[2])]
    noise = np.maximum(np.array(spread) / np.sqrt(20.0), 1e-6 * np.abs(y).max(axis=(0, 1)))
    return np.where(valid.any(axis=(0, 1)), noise, UNMEASURED)


def robust_deviation(values: np.ndarray) -> float:
    """Return the standard deviation of normal `values` (n,) about zero, from the median of their size; 0 of none."""
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0


def restricted_likelihood(
    logs: Float[Array, "7"], steps: Steps, e: Array, L: Array, dt: float, informative: Array
) -> Float[Array, ""]:
    """Return minus twice the restricted log-likelihood for the logarithms of `Noise.as_vector`; leading axis of pieces.

    `e` are innovations under the gains `L`; those under other gains follow to first order. Only innovations
    where `informative` (T, 3) is 1 do.
    """
    noise = jnp.exp(logs)
    decay = jnp.exp(-dt / noise[6])

    def piece(steps, e, L):
        gains = kalman_gains(steps.A[:, :3, :3], steps.valid, noise[:3], noise[3:6], decay, dt, informative)
        J = propagate_derivatives(steps, gains, dt)
        e = innovations_with_gains(steps, e, L, gains, dt)
        return (
            gains.log_det,
            jnp.einsum("tij,tj->ti", gains.whitening, e),
            jnp.einsum("tij,tjk->tik", gains.whitening, J),
        )

    log_det, e_w, J_w = jax.vmap(piece)(steps, e, L)
    K = J_w.shape[-1]
    H = jnp.einsum("ptik,ptil->kl", J_w, J_w) + jnp.eye(K) / PRIOR**2
    factor = jnp.linalg.cholesky(H)
    b = jax.scipy.linalg.solve_triangular(factor, jnp.einsum("ptik,pti->k", J_w, e_w), lower=True)
    parameters = 2 * jnp.sum(jnp.log(jnp.diagonal(factor)))
    return jnp.sum(e_w**2) - jnp.sum(b**2) + 2 * jnp.sum(log_det) + parameters


def _search(
    first: Array, low: Array, high: Array, steps: Steps, e: Array, L: Array, dt: float, informative: Array
) -> Minimum:
    """Minimise `restricted_likelihood` per measurement within bounds, in scaled logarithms."""
    rows, stiff = jnp.maximum(jnp.sum(steps.valid), 1.0), jnp.asarray(LOG_SCALES)
    value = lambda x, first, steps, e, L, use: restricted_likelihood(first + x / stiff, steps, e, L, dt, use) / rows
    lower, upper, options = (
        (low - first) * stiff,
        (high - first) * stiff,
        {"tolerance": GRADIENT_TOLERANCE, "max_steps": ITERATIONS},
    )
    found = minimise_within(value, 0 * first, lower, upper, first, steps, e, L, informative, **options)
    return eqx.tree_at(lambda m: m.x, found, first + found.x / stiff)


def spread_pieces(trees: tuple[Steps, Array, Array]) -> tuple[Steps, Array, Array]:
    """Return pieces of `trees` (P, T, ...) that hold `SEARCHED` samples, spread evenly; zeros where there are fewer."""
    P, T = trees[1].shape[:2]
    num = max(SEARCHED // T, 1)
    rows = np.round(np.linspace(0, P - 1, num)).astype(int) if P > num else np.arange(P)
    pad = lambda a: np.concatenate([np.asarray(a)[rows], np.zeros((num - len(rows), *a.shape[1:]), a.dtype)])
    return jax.tree.map(pad, trees)


def estimate_noise(steps: Steps, e: Array, gains: Gains, start: Noise, dt: float, informative: np.ndarray) -> Noise:
    """Estimate the noise from innovations `e` (P, T, 3) under `gains`, starting the search from `start`.

    It is estimated from `SEARCHED` samples, in pieces spread over the log; fewer are padded with pieces that hold no
    measurement: seven numbers need no more, and one program serves all logs. Only innovations where
    `informative` (T, 3) is true do; a channel of which none does, or that is not measured, keeps the noise of `start`.
    """
    steps, e, L = spread_pieces((steps, e, gains.L))
    low = np.concatenate([0.2 * start.sigma, 1e-3 * start.disturbance, [2 * dt]])
    high = np.concatenate([5 * start.sigma, 1e3 * start.disturbance, [5.0]])
    tells = informative.any(axis=0) & np.asarray(steps.valid).any(axis=(0, 1))  # channels that say what they err by
    low[:3], high[:3] = np.where(tells, low[:3], start.sigma), np.where(tells, high[:3], start.sigma)
    high[3:6] = np.where(tells, high[3:6], UNSEEN * start.disturbance)
    first, lower, upper = (jnp.asarray(np.log(row)) for row in (start.as_vector(), low, high))
    best = np.exp(call(_search, first, lower, upper, steps, e, L, dt, jnp.asarray(informative, float)).x)
    return Noise(best[:3], best[3:6], float(best[6]))
