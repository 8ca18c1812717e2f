"""Estimate measurement and process noise from the data, by the restricted likelihood of the innovations.

The noise is what no effect of the catalogue explains: the parameters of all of them are profiled out to first order,
so that missing physics is not mistaken for noise (Harville 1977, Eq. 3.1; Kristensen, Madsen and Jorgensen 2004 for
process noise as the measure of a model's defect).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.diagnosis.noise_model import Noise
from driftjax.diagnosis.observer import (
    Gains,
    Steps,
    innovations_with_gains,
    kalman_gains,
    propagate_derivatives,
    propagate_pieces,
)
from driftjax.diagnosis.quadratic import minimise_quadratic
from driftjax.parallel import call

PRIOR = 3.0  # standard deviation of a parameter before any data, in typical sizes
FIRST_DISTURBANCE = 10.0  # disturbance assumed before any is known, in measurement noise per second
SILENT_DISTURBANCE = 1.5  # that of a channel that is not measured, in the same unit
UNMEASURED_RISE = 10.0  # largest disturbance of such a channel, over the assumed one
CORRELATION = 0.3  # correlation time of disturbances assumed before any is known [s]
UNMEASURED = 0.05  # standard deviation of an unmeasured channel: of a sideslip, half at the start [rad]
LINEAR = 0.1  # slow errors over measurement noise, disturbances over first ones, below which variances are searched
FIRST_SLOW = 0.3  # slow errors assumed before any are known, in measurement noise
NO_SLOW = 1e-3  # least slow errors, in measurement noise
MOST_SLOW = 100.0  # largest slow errors: in a filtered log white errors nearly vanish
SLOW_CORRELATION = 0.3  # correlation time of slow errors assumed before any are known [s]
LONGEST_SLOW = 1.0  # largest correlation time of slow errors: what lasts longer has a cause to be named, as a bias [s]
SLOW_EVIDENCE = 18.5  # least rise of twice the log-likelihood by slow errors: 0.999 quantile of chi^2 of 4 parameters
FIRST_FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # of disturbances, the best of which begins the search
FIRST_CORRELATIONS = (0.1, 0.3, 1.0, 3.0)  # and with which correlation time [s]
SEARCHED = 8000  # samples that the noise is estimated from
CUT = 250  # samples by which padding is cut off
ITERATIONS = 30  # of the search, at most
LONG = 1.0  # correlation time of disturbances from which the search begins again at shorter ones [s]
LONGEST = 1.5  # longest step of any variable of the search
DAMPING = 1e-2  # of the first step of the search, over the curvature
EVERY = 2  # pieces of which one gives the curvature, which need not be exact
LEAST_CURVATURE = 1e-3  # added, since a correlation time has none where its noise vanishes
PROMISE = 3e-3  # predicted rise of twice the log-likelihood below which the search ends
HOPE = 10.0  # times what a step promises, a search may still fall short of its goal and go on

QuadraticModel = tuple[float, np.ndarray, np.ndarray]  # value, gradient (n,), half the expected curvature (n, n)


def measurement_noise(y: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return an initial guess (c,) from third differences of y (P, T, c), robust to outliers."""
    d = np.diff(y, n=3, axis=1)
    whole = np.min([valid[:, k : k + d.shape[1]] for k in range(4)], axis=0) > 0
    spread = [robust_deviation(d[..., i][whole[..., i]]) for i in range(y.shape[2])]
    noise = np.maximum(np.array(spread) / np.sqrt(20.0), 1e-6 * np.abs(y).max(axis=(0, 1)))
    return np.where(valid.any(axis=(0, 1)), noise, UNMEASURED)


def robust_deviation(values: np.ndarray) -> float:
    """Return the standard deviation of normal `values` (n,) about zero, from their median size; 0 without values."""
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0


def measured_channels(valid: np.ndarray) -> np.ndarray:
    """Return which channels (3,) are measured, by `valid` (P, T, 3): those whose disturbance is determined.

    That of a speed from which the drive force was estimated is the error of this force, which the others show.
    """
    return np.asarray(valid.any(axis=(0, 1)))


def observed_channels(valid: np.ndarray, informative: np.ndarray) -> np.ndarray:
    """Return which channels (3,) determine the noise of their sensor: measured, with innovations that count."""
    return informative.any(axis=0) & measured_channels(valid)


def restricted_likelihood(
    noise: Float[Array, "11"], steps: Steps, e: Array, L: Array, dt: float, informative: Array
) -> tuple[Float[Array, ""], Float[Array, " K"]]:
    """Return minus twice the restricted log-likelihood of `noise` as `Noise.as_vector`; leading axis of pieces.

    `e` are innovations under the gains `L`; those under other gains follow to first order. Only innovations
    where `informative` (T, 3) is 1 do. The parameters that fit best under this noise are returned with it.
    """
    known = Noise.from_vector(noise)

    def piece(steps, e, L):
        gains = kalman_gains(steps.A[:, :3, :3], steps.push[:, :3], steps.valid, known, dt, informative)
        J = propagate_derivatives(steps, gains)
        e = innovations_with_gains(steps, e, L, gains)
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
    theta = -jax.scipy.linalg.solve_triangular(factor, b, lower=True, trans=1)
    return jnp.sum(e_w**2) - jnp.sum(b**2) + 2 * jnp.sum(log_det) + parameters, theta


def likelihoods(noises: Float[Array, "n 11"], steps: Steps, e: Array, L: Array, dt: float, informative: Array) -> Array:
    """Return `restricted_likelihood` (n,) of several noises, one after the other."""
    return jax.lax.map(lambda noise: restricted_likelihood(noise, steps, e, L, dt, informative)[0], noises)


class NoiseScale(NamedTuple):
    """Scale of the variables of the search: logarithms of variances, with an offset where they may vanish."""

    first: Float[Array, "11"]  # noise at variables 0
    offset: Float[Array, "11"]  # noise below which a variable is linear in the variance

    def variables(self, noise: Array) -> Array:
        """Return the variables of a noise vector."""
        return jnp.log((noise**2 + self.offset**2) / (self.first**2 + self.offset**2)) / 2

    def noise(self, x: Array) -> Array:
        """Return the noise vector of variables."""
        return jnp.sqrt((self.first**2 + self.offset**2) * jnp.exp(2 * x) - self.offset**2)


def search_scale(first: Noise) -> NoiseScale:
    """Return the scale of the variables for a search that starts at the noise `first`."""
    zero = np.zeros(3)
    offset = Noise(zero, LINEAR * first.disturbance, 0.0, LINEAR * first.sigma, 0.0)
    return NoiseScale(jnp.asarray(first.as_vector()), jnp.asarray(offset.as_vector()))


def information_of_noise(
    x: Float[Array, "11"], scale: NoiseScale, steps: Steps, e: Array, L: Array, dt: float, informative: Array
) -> Float[Array, "11 11"]:
    """Return half the expected curvature of `restricted_likelihood` in the variables, for known parameters.

    Ljung 1999, Eq. 9.29 and 7.88. That of the innovations' derivatives is taken from `e`, which should hold nothing
    that the car gets wrong.
    """

    def whitened(x, steps, e, L):
        gains = kalman_gains(
            steps.A[:, :3, :3], steps.push[:, :3], steps.valid, Noise.from_vector(scale.noise(x)), dt, informative
        )
        return (gains.whitening, innovations_with_gains(steps, e, L, gains)), gains.whitening

    def piece(steps, e, L):
        (by_whitening, by_e), whitening = jax.jacfwd(whitened, has_aux=True)(x, steps, e, L)
        # a channel that does not count has no row: one on the diagonal lets the factor be inverted
        full = whitening + jax.vmap(jnp.diag)(jnp.where(jnp.any(whitening, axis=-1), 0.0, 1.0))
        G = jnp.einsum("tijn,tjk->tikn", by_whitening, jnp.linalg.inv(full))
        symmetric, moved = G + jnp.swapaxes(G, 1, 2), jnp.einsum("tij,tjn->tin", whitening, by_e)
        return jnp.einsum("tijn,tijm->nm", symmetric, symmetric) / 2 + jnp.einsum("tin,tim->nm", moved, moved)

    return jnp.sum(jax.vmap(piece)(steps, e, L), axis=0)


def _expansion(x: Array, scale: NoiseScale, steps: Steps, e: Array, J: Array, L: Array, dt: float, informative: Array):
    """Return `restricted_likelihood`, its gradient, and `information_of_noise` from every `EVERY`-th piece."""
    value = lambda x: restricted_likelihood(scale.noise(x), steps, e, L, dt, informative)
    (cost, theta), slope = jax.value_and_grad(value, has_aux=True)(x)
    some, own, L = jax.tree.map(lambda a: a[::EVERY], (steps, e + J @ theta, L))
    share = jnp.sum(some.valid) / jnp.maximum(jnp.sum(steps.valid), 1.0)
    return cost, slope, information_of_noise(x, scale, some, own, L, dt, informative) / share


def fisher_scoring(
    expand: Callable[[np.ndarray], QuadraticModel], lower: np.ndarray, upper: np.ndarray, goal: float = np.inf
) -> tuple[np.ndarray, float]:
    """Minimise within bounds from 0 by damped Fisher scoring; returns the variables (n,) and the value.

    `expand` gives value, gradient and half the expected curvature. Damping as in Levenberg and Marquardt (Nocedal and
    Wright 2006, Sec. 10.3): it grows where a step does not lower the value. The search ends where its steps promise too
    little to reach a value below `goal`.
    """
    x, damping = np.clip(np.zeros(len(lower)), lower, upper), DAMPING
    value, slope, H = expand(x)
    for _ in range(ITERATIONS):
        damped = H + np.diag(damping * np.diag(H) + LEAST_CURVATURE)
        step = minimise_quadratic(-slope / 2, damped, np.maximum(lower - x, -LONGEST), np.minimum(upper - x, LONGEST))
        promise = -slope @ step - step @ H @ step
        if not promise > PROMISE or value - HOPE * promise > goal:
            break
        after = expand(x + step)
        if after[0] < value:
            x, (value, slope, H), damping = x + step, after, damping / 10
        else:
            damping = 10 * max(damping, DAMPING)
    return x, value


def spread_pieces(steps: Steps, e: Array, gains: Gains) -> tuple[Steps, Array, Gains]:
    """Return pieces (P, T, ...) that hold `SEARCHED` samples, spread evenly; zeros where there are fewer.

    What pads all of them is cut off, by whole `CUT` samples: few lengths are few programs.
    """
    P, T = e.shape[:2]
    num = max(SEARCHED // T, 1)
    rows = np.round(np.linspace(0, P - 1, num)).astype(int) if P > num else np.arange(P)
    last = int(np.flatnonzero(np.asarray(steps.valid)[rows].any(axis=(0, 2)))[-1:].sum())
    samples = slice(min(CUT * (last // CUT + 1), T))

    def pad(a: Array) -> Any:
        return np.concatenate([np.asarray(a)[rows], np.zeros((num - len(rows), *a.shape[1:]), a.dtype)])

    def cut(a: Array) -> Any:
        return pad(a[:, samples])

    shorter = Steps(**{name: (pad if name == "first" else cut)(a) for name, a in steps._asdict().items()})
    decay = jax.tree.map(pad, gains.decay)
    return shorter, cut(e), Gains(cut(gains.L), cut(gains.whitening), decay, cut(gains.P), pad(gains.log_det))


def estimate_noise(
    steps: Steps, e: Array, gains: Gains, start: Noise, dt: float, informative: np.ndarray, *, slow_known: bool = False
) -> Noise:
    """Estimate the noise from innovations `e` (P, T, 3) under `gains`, starting the search from `start`.

    It is estimated from `SEARCHED` samples, in pieces spread over the log; fewer are padded with pieces that hold no
    measurement: eleven numbers need no more, and one program serves all logs. Only innovations where `informative`
    (T, 3) is true do; a channel of which none does, or that is not measured, keeps the noise of `start`. Sensors have
    slow errors where the data ask for them; where they are `slow_known`, those of `start`. The search begins at the
    most likely of `first_noises`.
    """
    steps, e, gains = spread_pieces(steps, e, gains)
    informative = informative[: e.shape[1]]
    J, use = call(propagate_pieces, steps, gains), jnp.asarray(informative, float)

    def minimise(first: Noise, low: Noise, high: Noise, goal: float = np.inf) -> tuple[Noise, float]:
        scale = search_scale(first)
        lower, upper = (np.asarray(scale.variables(jnp.asarray(one.as_vector()))) for one in (low, high))

        def expand(x: np.ndarray) -> QuadraticModel:
            value, slope, H = call(_expansion, jnp.asarray(x), scale, steps, e, J, gains.L, dt, use)
            return float(value), np.asarray(slope), np.asarray(H)

        x, value = fisher_scoring(expand, lower, upper, goal)
        return Noise.from_vector(np.asarray(scale.noise(jnp.asarray(x)))), value

    valid = np.asarray(steps.valid)
    observed = observed_channels(valid, informative)
    low, high = noise_bounds(start, measured_channels(valid), observed, dt)
    least = start if slow_known else start._replace(slow=low.slow)
    fixed = {"slow": least.slow, "slow_correlation": least.slow_correlation}
    several = first_noises(least, measured_channels(valid))
    costs = call(likelihoods, jnp.stack([one.as_vector() for one in several]), steps, e, gains.L, dt, use)
    within = low._replace(**fixed), high._replace(**fixed)
    white, cost = minimise(likeliest(several, costs), *within)
    if white.correlation > LONG:  # beside such a minimum there may be a lower one of short disturbances
        other = minimise(likeliest(several, costs, LONG), *within)
        white, cost = other if other[1] < cost else (white, cost)
    if slow_known or not observed[1]:  # a sideslip inferred from sensors with slow errors is lost where the car drifts
        return white
    goal, first = cost - SLOW_EVIDENCE, white._replace(slow=np.where(observed, start.slow, low.slow))
    slow, lower_cost = minimise(first, low, high, goal)
    return slow if lower_cost < goal else white


def likeliest(noises: list[Noise], costs: Array, below: float = np.inf) -> Noise:
    """Return the noise of the lowest of `costs` (n,) with disturbances that last for less than `below` [s].

    An observer that loses the car has no cost.
    """
    out = np.isnan(costs) | np.array([one.correlation >= below for one in noises])
    return noises[int(np.argmin(np.where(out, np.inf, costs)))]


def first_noises(start: Noise, measured: np.ndarray) -> list[Noise]:
    """Return noises to begin a search from: disturbances of several sizes, where `measured` (3,), and durations.

    The likelihood has several minima: long disturbances, or short ones whose parameters explain what they leave.
    """
    return [
        start._replace(disturbance=np.where(measured, factor, 1.0) * start.disturbance, correlation=time)
        for factor in FIRST_FACTORS
        for time in FIRST_CORRELATIONS
    ]


def noise_bounds(start: Noise, measured: np.ndarray, observed: np.ndarray, dt: float) -> tuple[Noise, Noise]:
    """Return the bounds of the noise; sensors that are not `observed` (3,) keep their white errors alone.

    The disturbances of channels that are not `measured` (3,) stay small.
    """
    low = Noise(
        np.where(observed, 0.2, 1.0) * start.sigma, 1e-4 * start.disturbance, 2 * dt, NO_SLOW * start.sigma, 2 * dt
    )
    high = Noise(
        np.where(observed, 5.0, 1.0) * start.sigma, np.where(measured, 1e3, UNMEASURED_RISE) * start.disturbance, 5.0,
        np.where(observed, MOST_SLOW, NO_SLOW) * start.sigma, LONGEST_SLOW,
    )  # fmt: skip
    return low, high
