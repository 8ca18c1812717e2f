"""Fit chosen effects to a log: by single steps, and where these leave errors, by an observer of long memory."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.comparison import Comparison, compare_on_own_runs
from driftjax.diagnosis.fit import Fit, Problem, evaluate_fit, information, linearise, with_estimated_noise
from driftjax.diagnosis.identifiability import DEAD
from driftjax.diagnosis.memory import with_long_memory
from driftjax.diagnosis.multistart import nominal_fit, require_finite_cost
from driftjax.diagnosis.predictive_naming import TOLERATED, error_change, leaves_errors, without_own_parts
from driftjax.diagnosis.refine import refit_to_convergence
from driftjax.diagnosis.runs import Linearisation
from driftjax.diagnosis.stages import StagedFit, fit_staged
from driftjax.diagnosis.stretches import find_stretches


class CalibrationFit(NamedTuple):
    """Effects fitted to the innovations of one observer."""

    problem: Problem  # from the states of whose observer predictions start
    searched: Problem  # to the innovations of whose observer the car is fitted
    fit: Fit
    linearisation: Linearisation  # weighted as in the fit
    stretch: np.ndarray  # (P, T) kind of stretch of each sample
    precision: np.ndarray  # (K, K) that the data give the parameters, and a tenth of the prior
    prior: np.ndarray  # (K,) precision of the prior, as it counted
    moved: np.ndarray  # (K,) change by later stages, in standard deviations of the estimate of the own stage

    @property
    def by_predictions(self) -> bool:
        """Return whether the car is fitted with an observer of long memory."""
        return self.searched is not self.problem


def fit_by_steps(
    loose: Problem, selected: tuple[int, ...], staged: bool, report: Callable[[str], None] = lambda text: None
) -> CalibrationFit:
    """Fit the effects `selected` by the likelihood of single steps, with the noise of the fitted car.

    The first car may be far off: in the problem `loose` it is followed with the disturbances that it needs for itself.
    """
    if staged:
        near, fit, stages = fit_staged(loose, selected, report=report)
        return _of_stages(near, near, fit, stages)
    columns = loose.columns(selected)
    rough, _ = refit_to_convergence(loose, require_finite_cost(nominal_fit(loose)), columns)
    near = with_estimated_noise(loose, rough.theta, np.isin(np.arange(len(loose.owner)), columns))
    return _at_once(near, near, rough.theta, columns)


def fit_by_predictions(
    steps: CalibrationFit, selected: tuple[int, ...], staged: bool, report: Callable[[str], None] = lambda text: None
) -> CalibrationFit | None:
    """Fit the effects `selected` with an observer of long memory; None where there is none."""
    long = with_long_memory(steps.problem)
    if long is None:
        return None
    report("long memory")
    if staged:
        _, fit, stages = fit_staged(long, selected, long, lambda text: report(f"long memory, {text}"))
        return _of_stages(steps.problem, long, fit, stages)
    return _at_once(steps.problem, long, long.start, long.columns(selected))


def fit_by_the_better(
    loose: Problem,
    selected: tuple[int, ...],
    staged: bool,
    seed: int,
    report: Callable[[str], None] = lambda text: None,
) -> CalibrationFit:
    """Fit by single steps, and by predictions where these leave errors; return the fit that predicts better.

    Both predict parts of the runs that they are fitted without. Predictions must lower the error of all channels
    together by more than the share `TOLERATED`, and its standard error: of a right car, single steps give the more
    precise parameters.
    """
    steps = fit_by_steps(loose, selected, staged, report)
    own = _compare(loose, steps, selected, seed)
    if not leaves_errors(own, TOLERATED, seed):
        return steps
    other = fit_by_predictions(steps, selected, staged, report)
    if other is None:
        return steps
    change = error_change(own, _compare(loose, other, selected, seed))
    return other if change.total < min(np.log1p(-TOLERATED), -change.total_error) else steps


def _at_once(problem: Problem, searched: Problem, theta: np.ndarray, columns: np.ndarray) -> CalibrationFit:
    """Fit the parameters `columns` of `searched` from `theta` (K,), all stretches alike."""
    fit, linearisation = refit_to_convergence(searched, require_finite_cost(evaluate_fit(searched, theta)), columns)
    prior, precision = np.diag(searched.prior), information(linearisation.J) + DEAD * searched.prior
    return CalibrationFit(
        problem, searched, fit, linearisation, find_stretches(searched), precision, prior, np.zeros(len(prior))
    )


def _of_stages(problem: Problem, searched: Problem, fit: Fit, stages: StagedFit) -> CalibrationFit:
    linearisation = stages.weigh(linearise(searched, fit))
    return CalibrationFit(
        problem, searched, fit, linearisation, stages.stretch, stages.precision, stages.prior, stages.moved
    )


def _compare(loose: Problem, car: CalibrationFit, selected: tuple[int, ...], seed: int) -> Comparison:
    """Compare the nominal and the fitted car on own runs, the latter fitted without the part that it predicts."""
    own = compare_on_own_runs(loose, loose.start, car.problem, car.fit.theta, seed, disturbed=False)
    return without_own_parts(own, car.searched, car.fit, car.linearisation, selected)
