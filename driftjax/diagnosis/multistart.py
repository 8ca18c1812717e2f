"""A search that begins far from the truth: with an observer that follows whatever acts on the nominal car."""

import numpy as np

from driftjax.core import BadInput
from driftjax.diagnosis.fit import Fit, Problem, evaluate, refit_to_convergence, with_estimated_noise
from driftjax.diagnosis.select import MAX_EFFECTS, Selection, prune, search

LOST_MISFIT = (
    200.0  # cost per measurement from which the observer of the nominal car has lost it: 14 standard deviations
)
POOR_MISFIT = 1.5  # and from which a fit is not one: noise is what no effects explain, so a right one ends near 1


def nominal_fit(problem: Problem) -> Fit:
    """The car before anything is named."""
    return evaluate(problem, problem.start)


def misfit(problem: Problem, fit: Fit) -> float:
    """Cost per measurement: 1 for a right model."""
    return fit.cost / float(np.sum(np.asarray(problem.data.padded.valid)))


def require_finite(fit: Fit) -> Fit:
    """`fit`, if its observer has not lost the car."""
    if not np.isfinite(fit.cost):
        raise BadInput("log: the observer of the nominal car loses these data; check units, signs and the vehicle.")
    return fit


def search_multistart(problem: Problem, seed: int = 0, most: int = MAX_EFFECTS) -> tuple[Problem, Selection]:
    """What is found in `problem`, with the problem that it was found in: the same one but where that leads nowhere.

    Strong effects in data of little disturbance throw the observer of the nominal car off, whose noise is what remains
    beside all effects; then the search goes round about.
    """
    start = nominal_fit(problem)
    close = search(problem, start, seed, most=most) if misfit(problem, start) < LOST_MISFIT else None
    if close and misfit(problem, close.fit) < POOR_MISFIT:
        return problem, close
    anew, selection = search_from_far(problem, seed, most)
    if close and misfit(problem, close.fit) <= misfit(anew, selection.fit):
        return problem, close
    return anew, selection


def with_nominal_noise(problem: Problem) -> Problem:
    """The problem with the noise that the nominal car needs for itself: nothing is explained away."""
    return with_estimated_noise(problem, problem.start, np.zeros_like(problem.active))


def search_from_far(problem: Problem, seed: int = 0, most: int = MAX_EFFECTS) -> tuple[Problem, Selection]:
    """What is found with the disturbances that the nominal car needs for itself, weighed once more with noise and
    observer of the car found."""
    loose = with_nominal_noise(problem)
    start = require_finite(nominal_fit(loose))
    rough = search(loose, start, seed, most=most)
    anew = with_estimated_noise(problem, rough.fit.theta, problem.active)
    fit = refit_to_convergence(anew, evaluate(anew, rough.fit.theta), anew.columns(rough.selected))[0]
    selected, fit = prune(anew, rough.selected, require_finite(fit))
    selection = search(anew, fit, seed, selected, most)
    return anew, selection._replace(base=loose, nominal=start, nominal_scores=rough.nominal_scores)
