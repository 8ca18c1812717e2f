"""Give the observer a memory as long as predictions: for cars that are not right, which single steps mislead.

The disturbances of the observer stand for what the car gets wrong. Where sensors are smooth and the car is wrong they
are large: the observer forgets within a few samples, and its innovations show only what one sample gets wrong. With
smaller disturbances it follows the car for as long as predictions last, and its innovations are the errors that
predictions make. Such disturbances are white: those that last would themselves be estimated, and take in what the car
gets wrong, while predictions carry none ahead. The assumed noise decides which errors a fit weighs (Ljung 1999,
Sec. 8.5); where the car is right, both lead to the same parameters.
"""

import numpy as np

from driftjax.diagnosis.fit import Fit, Problem, evaluate_fit, information, linearise, with_noise
from driftjax.diagnosis.gain import DECISIVE, horizon_steps
from driftjax.diagnosis.noise_model import Noise
from driftjax.logs.columns import MEASURED

NO_SLOW = 1e-3  # slow errors of the sensors beside white ones: they would take in what the car gets wrong
WHITE = 2.0  # correlation time of the disturbances, in samples: the least that noise is estimated with
LEAST = 1e-3  # least disturbances, over those of the same power as the estimated ones
HALVINGS = 8  # of the interval in which the disturbances are searched, by the logarithm


def with_long_memory(problem: Problem) -> Problem | None:
    """Return the problem with an observer that remembers as long as shares of the error are measured ahead.

    None where it does already, or where it loses the nominal car. All disturbances are white and reduced by one factor,
    and sensors have white errors alone. Innovations within a memory depend on each other, and count as one: the noise
    is scaled so that what no effect explains costs 1 for each channel and memory.
    """
    horizon = float(horizon_steps(problem)[DECISIVE])
    if memory_of(problem) >= horizon:
        return None
    white, low, high = _with_white_errors(problem.noise, WHITE * problem.data.dt), np.log(LEAST), 0.0
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        long = with_noise(problem, problem.start, _reduced(white, float(np.exp(middle))))
        low, high = (middle, high) if memory_of(long) >= horizon else (low, middle)
    noise = _reduced(white, float(np.exp(low)))
    long = with_noise(problem, problem.start, noise)
    nominal = evaluate_fit(long, long.start)
    if not np.isfinite(nominal.cost):
        return None
    scale = float(np.sqrt(_unexplained_power(long, nominal) * memory_of(long)))
    return with_noise(problem, problem.start, _scaled(noise, scale))


def memory_of(problem: Problem) -> float:
    """Return the samples after which the observer has forgotten a measurement: geometric mean over channels."""
    valid = np.asarray(problem.data.padded.valid) * problem.data.informative
    own = np.asarray(problem.gains.L)[..., range(len(MEASURED)), range(len(MEASURED))][valid > 0]
    return float(np.exp(-np.mean(np.log(own[own > 0]))))


def _with_white_errors(noise: Noise, correlation: float) -> Noise:
    """Return the noise with all errors of the sensors white, and disturbances of this correlation time [s] and power.

    Power is the variance times the correlation time: it is what they add to the variance of the state in a second.
    """
    disturbance = np.sqrt(noise.correlation / correlation) * noise.disturbance
    return Noise(noise.total, disturbance, correlation, NO_SLOW * noise.sigma, noise.slow_correlation)


def _reduced(noise: Noise, share: float) -> Noise:
    """Return the noise with this share of the disturbances."""
    return noise._replace(disturbance=share * noise.disturbance)


def _scaled(noise: Noise, by: float) -> Noise:
    """Return the noise with all standard deviations scaled, which leaves the gains as they are."""
    return noise._replace(sigma=by * noise.sigma, disturbance=by * noise.disturbance, slow=by * noise.slow)


def _unexplained_power(problem: Problem, nominal: Fit) -> float:
    """Return the mean square of whitened innovations that no effect explains, to first order about the nominal car."""
    channels, free = slice(len(MEASURED)), problem.active
    e = np.asarray(nominal.e)[..., channels]
    J = np.asarray(linearise(problem, nominal).J)[..., channels, :][..., free]
    H = information(J) + problem.prior[np.ix_(free, free)]
    rest = e - J @ np.linalg.solve(H, np.einsum("ptij,pti->j", J, e, optimize=True))
    return float(np.sum(rest**2) / np.sum(np.asarray(problem.data.padded.valid) * problem.data.informative))
