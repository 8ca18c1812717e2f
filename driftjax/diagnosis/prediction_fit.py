"""Fit parameters to open-loop predictions: for cars that are not right, which a likelihood of single steps misleads.

The observer's likelihood is efficient for a right car. Of any other it fits what single steps show best, such as the
filter of a smooth sensor, and the car may predict a second ahead worse than it did before. Then the errors that count
are minimised themselves (simulation error minimisation; Farina and Piroddi 2010, Int. J. Control 83(6)).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import DECISIVE, at_horizons, predict
from driftjax.diagnosis.quadratic import minimise_quadratic
from driftjax.diagnosis.score import ParameterSpread, spread_of

HUBER = 2.0  # errors, over those of the nominal car, from which they count by magnitude: some starts spin
STEP = 1e-3  # of the differences that stand for derivatives, in typical sizes
STEEP = 100.0  # derivatives, of such errors by typical sizes, above which a prediction spins and tells no direction
DAMPING = (1e-3, 1e-2, 1e-1, 1.0, 10.0)  # shares of the information that are added, in turn (Marquardt 1963)
ROUNDS = 12
FALL = 0.05  # fall of the objective that ends the fit: about a fifth of a standard deviation


class PredictionFit(NamedTuple):
    """Parameters that predict best, with what their intervals follow from."""

    theta: np.ndarray  # (K,) in typical sizes
    columns: np.ndarray  # (k,) fitted parameters
    H: np.ndarray  # (K, K) information, prior included
    blocks: np.ndarray  # (C, K) scores by block of time, zero but for the fitted parameters
    lowered: float  # robust RMS of the errors, over that of the first start

    @property
    def spread(self) -> ParameterSpread:
        """Return the uncertainty of the fitted parameters."""
        return spread_of(self.H, self.blocks, self.columns)

    def without(self, problem: Problem, gone: np.ndarray) -> np.ndarray:
        """Return theta (K,) with the parameters `gone` at the nominal car's, the others fitted again to first order."""
        theta, rest = self.theta.copy(), np.setdiff1d(self.columns, gone)
        theta[gone] = problem.start[gone]
        H, pull = self.H[np.ix_(rest, rest)], self.H[np.ix_(rest, gone)] @ (theta - self.theta)[gone]
        lower, upper = (side[rest] - theta[rest] for side in (problem.lower, problem.upper))
        theta[rest] += minimise_quadratic(-pull, H, lower, upper)
        return theta


class _Reference(NamedTuple):
    """Open-loop errors of the nominal car, by which those of others are scaled: n starts, m channels and horizons."""

    problem: Problem
    scale: np.ndarray  # (m,) RMS, 1 where there is none
    error: np.ndarray  # (n, m) scaled, NaN where nothing was measured
    block: np.ndarray  # (n,) number of the block of time
    num_blocks: int


class _Trial(NamedTuple):
    """Open-loop errors of one car."""

    theta: np.ndarray  # (K,)
    error: np.ndarray  # (n, m) scaled, 0 where nothing was measured
    total: float  # sum of Huber's function of them
    objective: float


def fit_to_predictions(problem: Problem, starts: Sequence[np.ndarray], columns: np.ndarray) -> PredictionFit:
    """Return the parameters `columns` that minimise open-loop errors 1 and 2 sqrt(L/g) ahead.

    The others keep the values of the best of `starts` (K,), from which Gauss-Newton steps begin. Every channel and
    horizon weighs by its error with the nominal car. The variance is profiled out, and each block of time counts as one
    observation, since predictions that overlap share their errors: C log(sum of squares) + prior. A prediction that a
    car lacks, since its sensors are late, costs what it costs with the nominal car.
    """
    reference = _reference(problem)
    if not len(columns):
        return PredictionFit(
            starts[0], columns, problem.prior, np.zeros((reference.num_blocks, len(problem.start))), 1.0
        )
    trials = [_try(reference, theta) for theta in starts]
    best = min(trials, key=lambda one: one.objective)
    H, blocks = _quadratic(reference, best, columns)
    for _ in range(ROUNDS):
        trial = _damped_step(reference, best, H, blocks, columns)
        if trial is None:
            break
        fall, best = best.objective - trial.objective, trial
        H, blocks = _quadratic(reference, best, columns)
        if fall < FALL:
            break
    lowered = float(np.sqrt(best.total / trials[0].total))
    return PredictionFit(best.theta, columns, H + problem.prior, blocks, lowered)


def _errors(problem: Problem, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors (n, m) up to the decisive horizon, NaN where there is none, and the block (n,) of starts."""
    errors = at_horizons(problem, predict(problem, theta, last=DECISIVE).error)
    ahead = errors.squares[:, 1:]  # not those of a single step
    return ahead.reshape(len(ahead), -1), np.unique(errors.block, return_inverse=True)[1]


def _reference(problem: Problem) -> _Reference:
    error, block = _errors(problem, problem.start)
    known = np.isfinite(error)
    power = np.where(known, error, 0.0) ** 2
    scale = np.sqrt(power.sum(axis=0) / np.maximum(known.sum(axis=0), 1))
    scale = np.where(scale > 0, scale, 1.0)
    return _Reference(problem, scale, np.where(known, error / scale, np.nan), block, int(block.max()) + 1)


def _try(reference: _Reference, theta: np.ndarray) -> _Trial:
    problem, known = reference.problem, np.isfinite(reference.error)
    error = _errors(problem, theta)[0] / reference.scale
    error = np.where(known, np.where(np.isnan(error), reference.error, error), 0.0)
    size, moved = np.abs(error), theta - problem.start
    total = float(np.where(size < HUBER, size**2, 2 * HUBER * size - HUBER**2).sum())
    return _Trial(theta, error, total, reference.num_blocks * np.log(total) + float(moved @ problem.prior @ moved))


def _quadratic(reference: _Reference, at: _Trial, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the information (K, K) and the scores by block (C, K) of the errors at one car, without the prior."""
    num = len(at.theta)
    J = np.stack([_derivative(reference, at, k) for k in columns], axis=-1)
    J[np.abs(J).max(axis=-1) > STEEP] = 0.0
    weight = reference.num_blocks / at.total * HUBER / np.maximum(np.abs(at.error), HUBER)
    H, blocks = np.zeros((num, num)), np.zeros((reference.num_blocks, num))
    H[np.ix_(columns, columns)] = np.einsum("nm,nmj,nmk->jk", weight, J, J, optimize=True)
    np.add.at(blocks, (reference.block[:, None], columns), -np.einsum("nm,nmk->nk", weight * at.error, J))
    return H, blocks


def _derivative(reference: _Reference, at: _Trial, column: int) -> np.ndarray:
    """Return the derivative (n, m) of the errors by one parameter: one more program would take long to compile."""
    step = STEP if at.theta[column] + STEP <= reference.problem.upper[column] else -STEP
    moved = at.theta.copy()
    moved[column] += step
    return (_try(reference, moved).error - at.error) / step


def _damped_step(
    reference: _Reference, at: _Trial, H: np.ndarray, blocks: np.ndarray, columns: np.ndarray
) -> _Trial | None:
    """Return the first of successively more damped steps that lowers the objective; None if none does."""
    problem, here = reference.problem, at.theta[columns]
    H = (H + problem.prior)[np.ix_(columns, columns)]
    score = (blocks.sum(axis=0) - problem.prior @ (at.theta - problem.start))[columns]
    for share in DAMPING:
        damped, theta = H + share * np.diag(np.diag(H)), at.theta.copy()
        theta[columns] = minimise_quadratic(
            score + damped @ here, damped, problem.lower[columns], problem.upper[columns]
        )
        if (trial := _try(reference, theta)).objective < at.objective:
            return trial
    return None
