"""Choose the next lap by its predicted lateral error and by what its data would teach.

The closed loop, linearised about the plan of candidate c, turns the part d~ of the model error that is not known into
a lateral error e = m_c + G_c d~, with d~ ~ N(0, S_c + noise) by the posterior of the Gaussian process at the inputs of
the plan. What the rows of data scatter about its mean acts on the car, too, and no data will lessen it. All that
follows is in metres: the expected error J_c, and the knowledge gradient (Frazier, Powell and Dayanik 2009), how much
lower the best expected error is, on average, once candidate c has been driven.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular
from jax.scipy.stats import norm
from jaxtyping import Bool, Float

from driftjax.gp import GP

SAMPLES = 64  # of the rows that driving a candidate would give
JITTER = 1e-9  # on the diagonal of a covariance, relative to its largest entry


class Prediction(eqx.Module):
    """Closed-loop lateral error of C candidates at T nodes along their plans."""

    z: Float[Array, "C T 5"]  # inputs of the Gaussian process
    mean: Float[Array, "C T"]  # lateral error where the learnt model is right [m]
    G: Float[Array, "C T T 3"]  # its change by an unknown rate error (dV, dbeta, dr) at each node [m per SI unit/s]
    weight: Float[Array, "C T"]  # of a node in the mean over the drift section, sums to 1
    rows: Array  # rows of data that a node stands for
    drivable: Bool[Array, " C"]  # whether the plan converged


class Assessment(NamedTuple):
    """Predictions for C candidates."""

    error: Float[Array, " C"]  # expected mean lateral error J_c [m]
    deviation: Float[Array, " C"]  # root mean square of the standard deviation of e along the plan [m]
    on_road: Float[Array, " C"]  # smallest probability along the plan that |e| is below the limit
    gain: Float[Array, " C"]  # knowledge gradient [m]


def expected_magnitude(mean: Array, deviation: Array) -> Array:
    """Return E|e| of e ~ N(mean, deviation^2) (folded normal distribution; Leone, Nelson and Nottingham 1961)."""
    safe = jnp.where(deviation > 0, deviation, 1.0)
    q = mean / safe
    folded = safe * jnp.sqrt(2 / jnp.pi) * jnp.exp(-0.5 * q**2) + mean * (1 - 2 * norm.cdf(-q))
    return jnp.where(deviation > 0, folded, jnp.abs(mean))


def _expected_error(p: Prediction, mean: Array, variance: Array) -> Array:
    """Return the expected mean error of candidates (C, ...) whose error has `mean`, `variance` (C, T, ...)."""
    magnitude = expected_magnitude(mean, jnp.sqrt(jnp.maximum(variance, 0.0)))
    return jnp.sum(p.weight.reshape(*p.weight.shape, *[1] * (mean.ndim - 2)) * magnitude, axis=1)


def _covariance(p: Prediction, gp: GP) -> Array:
    """Return the posterior covariance (3, C, T, C, T) of the rate errors at all nodes."""
    C, T = p.mean.shape
    return gp.covariance(p.z.reshape(C * T, -1)).reshape(3, C, T, C, T)


def _lateral(p: Prediction, covariance: Array) -> tuple[Array, Array]:
    """Return the covariance (3, C, T, C, T) of lateral and rate errors, and the former's latent variance (C, T)."""
    mixed = jnp.einsum("atkj,jakbm->jatbm", p.G, covariance)
    own = jnp.einsum("jatam->jatm", mixed)
    return mixed, jnp.einsum("jatm,atmj->at", own, p.G)


def _scatter(p: Prediction, gp: GP) -> Array:
    """Return the variance (C, T) of lateral errors from the noise of the rows, independent between nodes.

    Between nodes, some 0.2 s apart, the noise is independent; within a node it is not, as what it stands for, dynamics
    that the model lacks, lasts as long.
    """
    return jnp.einsum("atkj,j->at", p.G**2, gp.noise_variance)


def assess_candidates(p: Prediction, gp: GP, limit: Array, key: Array) -> Assessment:
    """Predict every candidate's error, its probability to stay within `limit` [m], and its knowledge gradient.

    After candidate c has been driven, the errors of all candidates have new means, m + H eps with eps standard normal,
    and smaller variances (Rasmussen and Williams 2006, Eq. 2.23-2.24). The gradient is the mean over `SAMPLES` draws of
    eps, the same for all candidates.
    """
    covariance = _covariance(p, gp)
    mixed, latent = _lateral(p, covariance)
    scatter = _scatter(p, gp)
    variance = latent + scatter
    error = _expected_error(p, p.mean, variance)
    best = jnp.min(jnp.where(p.drivable, error, jnp.inf))
    C, T = p.mean.shape
    eps = jax.random.normal(key, (3 * T, SAMPLES), p.mean.dtype)
    noise = gp.noise_variance / p.rows

    def after(c: Array) -> Array:
        """Return the mean of the least expected error after driving candidate `c`."""
        K = covariance[:, c, :, c, :] + noise[:, None, None] * jnp.eye(T)
        factor = jnp.linalg.cholesky(K)
        wide = mixed[:, :, :, c, :].reshape(3, C * T, T)
        H = jax.vmap(lambda L, M: solve_triangular(L, M.T, lower=True).T)(factor, wide).reshape(3, C, T, T)
        moved = jnp.einsum("jctk,jks->cts", H, eps.reshape(3, T, SAMPLES))
        left = variance - jnp.einsum("jctk,jctk->ct", H, H)
        errors = _expected_error(p, p.mean[..., None] + moved, jnp.broadcast_to(left[..., None], moved.shape))
        return jnp.mean(jnp.min(jnp.where(p.drivable[:, None], errors, jnp.inf), axis=0))

    deviation = jnp.sqrt(jnp.maximum(variance, 0.0))
    safe = jnp.where(deviation > 0, deviation, 1.0)
    inside = norm.cdf((limit - p.mean) / safe) - norm.cdf((-limit - p.mean) / safe)
    inside = jnp.where(deviation > 0, inside, (jnp.abs(p.mean) < limit).astype(float))
    spread = jnp.sqrt(jnp.sum(p.weight * deviation**2, axis=1))
    return Assessment(error, spread, jnp.min(inside, axis=1), best - jax.lax.map(after, jnp.arange(C)))


def sampled_errors(p: Prediction, gp: GP, key: Array, num: int) -> Float[Array, "num C"]:
    """Draw mean lateral errors of all candidates [m], averaged over the noise, for cars drawn from the posterior."""
    C, T = p.mean.shape
    K = _covariance(p, gp).reshape(3, C * T, C * T)
    jitter = JITTER * jnp.max(jnp.diagonal(K, axis1=1, axis2=2), axis=1)
    factor = jnp.linalg.cholesky(K + jitter[:, None, None] * jnp.eye(C * T))
    eps = jax.random.normal(key, (num, 3, C * T), K.dtype)
    d = jnp.einsum("jab,njb->nja", factor, eps).reshape(num, 3, C, T)
    e = p.mean + jnp.einsum("atkj,njak->nat", p.G, d)
    return jnp.sum(p.weight * expected_magnitude(e, jnp.sqrt(_scatter(p, gp))), axis=2)


def least_error(score: Array, drivable: Array) -> Array:
    """Return the index of the drivable candidate with the lowest `score` (C,)."""
    return jnp.argmin(jnp.where(drivable, score, jnp.inf))
