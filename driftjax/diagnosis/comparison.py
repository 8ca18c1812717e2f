"""Compare cars by their open-loop predictions on the same runs."""

from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import Errors, Predictions, Share, at_horizons, excess_shares, predict
from driftjax.diagnosis.noise_floor import noise_floor


class Comparison(NamedTuple):
    """Open-loop predictions of the compared models, on the held-out runs, or on all where there are none."""

    problem: Problem
    predictions: dict[str, Predictions]  # `nominal` and `extended` among them
    least: np.ndarray  # (P, S, N, 3) squares of the errors that a right model would have


def comparison_errors(comparison: Comparison) -> tuple[dict[str, Errors], Errors]:
    """Return the errors of every model at the horizons, and those that a right model would make."""
    problem = comparison.problem
    errors = {name: at_horizons(problem, one.error**2) for name, one in comparison.predictions.items()}
    return errors, at_horizons(problem, comparison.least)


def comparison_shares(comparison: Comparison, seed: int) -> dict[str, Share]:
    """Return the share of the excess error that each model of `comparison` removes."""
    return excess_shares(*comparison_errors(comparison), seed)


def compare_on_own_runs(
    base: Problem, nominal: np.ndarray, problem: Problem, theta: np.ndarray, seed: int, *, disturbed: bool = True
) -> Comparison:
    """Compare the `nominal` car (K,) of the problem `base` and the extended car `theta` (K,) on the runs of both.

    A right car errs by the noise of sensors and, where it is `disturbed`, by the estimated disturbances.
    """
    ahead = {"nominal": predict(base, nominal), "extended": predict(problem, theta)}
    return Comparison(problem, ahead, noise_floor(problem, theta, ahead["extended"], seed, disturbed=disturbed))
