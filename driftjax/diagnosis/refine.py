"""Fit hypotheses by Gauss-Newton on the active parameters, several of them in one batch."""

from collections.abc import Sequence

import numpy as np

from driftjax.diagnosis.fit import Fit, Problem, evaluate_fits, information, linearise
from driftjax.diagnosis.quadratic import minimise_quadratic
from driftjax.diagnosis.runs import Linearisation

STEP_LENGTHS = (0.5, 0.25, 0.1)  # of Gauss-Newton steps tried where the whole one does not lower the cost
TOLERANCE = 0.01  # fall of the cost below which a fit is done: a tenth of a standard deviation
REFITS = 6  # refinements, each about derivatives of its own, at most
REUSE_RATIO = 0.3  # fall of the cost, over that of the step before, above which derivatives are recomputed
NUM = 6  # Gauss-Newton steps of one refinement, at most


def gauss_newton_goal(
    problem: Problem, fit: Fit, columns: np.ndarray, J: np.ndarray, tolerance: float
) -> np.ndarray | None:
    """Return the end (K,) of the Gauss-Newton step in `columns`, with derivatives `J` (P, T, c, k) by them.

    None where the predicted fall of the cost is within the `tolerance`.
    """
    if not len(columns):
        return None
    H = information(J) + problem.prior[np.ix_(columns, columns)]
    score = np.einsum("ptij,pti->j", J, fit.e) - (problem.prior @ (fit.theta - problem.start))[columns]
    here, goal = fit.theta[columns], fit.theta.copy()
    goal[columns] = minimise_quadratic(score + H @ here, H, problem.lower[columns], problem.upper[columns])
    step = goal[columns] - here
    return goal if 2 * score @ step - step @ H @ step > tolerance else None


def refine(
    problem: Problem, fit: Fit, columns: np.ndarray, near: Linearisation, num: int = NUM, tolerance: float = TOLERANCE
) -> Fit:
    """Improve `fit` over `columns`, as `refine_together` does; return `fit` itself where it is the minimum."""
    return refine_together(problem, [fit], [columns], near, num, tolerance)[0]


def refine_together(
    problem: Problem, fits: Sequence[Fit], columns: Sequence[np.ndarray], near: Linearisation, num: int = NUM,
    tolerance: float = TOLERANCE,
) -> list[Fit]:  # fmt: skip
    """Improve each of `fits` over its `columns` by at most `num` Gauss-Newton steps, in one batch.

    Each until its cost falls by less than `tolerance`. Derivatives are those of a fit `near` them, which are kept while
    the cost falls fast (chord method; Kelley 1995, Sec. 5.4.1), for they take several times as long as the innovations.
    """
    fits, last, own = list(fits), [np.inf] * len(fits), {}
    going, J = list(range(len(fits))), np.asarray(near.J)
    for k in range(num):
        of = lambda i: own[i] if i in own else J[..., columns[i]]
        each = ((i, gauss_newton_goal(problem, fits[i], columns[i], of(i), tolerance)) for i in going)
        goals = {i: goal for i, goal in each if goal is not None}
        going = list(goals)
        trials = _line_search(problem, [fits[i] for i in going], list(goals.values()))
        falls = {i: fits[i].cost - trial.cost for i, trial in zip(going, trials, strict=True)}
        for i, trial in zip(going, trials, strict=True):
            fits[i] = trial
        going = [i for i in going if falls[i] > tolerance]
        for i in going if k + 1 < num else ():
            if falls[i] > REUSE_RATIO * last[i]:
                own[i] = np.asarray(linearise(problem, fits[i]).J)[..., columns[i]]
            last[i] = falls[i]
    return fits


def _line_search(problem: Problem, fits: Sequence[Fit], goals: Sequence[np.ndarray]) -> list[Fit]:
    """Return for each of `fits` the first of successively shorter steps to its goal (K,) that lowers the cost.

    It is the fit itself where none does. The whole steps are evaluated in one batch, and then all shorter ones.
    """
    if not fits:
        return []
    whole = evaluate_fits(problem, goals)
    failed = [i for i, trial in enumerate(whole) if not trial.cost < fits[i].cost]
    thetas = [fits[i].theta + length * (goals[i] - fits[i].theta) for i in failed for length in STEP_LENGTHS]
    shorter = iter(evaluate_fits(problem, thetas))
    for i in failed:
        each = [next(shorter) for _ in STEP_LENGTHS]
        whole[i] = next((trial for trial in each if trial.cost < fits[i].cost), fits[i])
    return whole


def refit_to_convergence(
    problem: Problem, fit: Fit, columns: np.ndarray, linearisation: Linearisation | None = None
) -> tuple[Fit, Linearisation]:
    """Refine `fit` over `columns` until its own derivatives give no further step; return it with its linearisation.

    `linearisation` is that at the given `fit`, where it is known.
    """
    linearisation = linearise(problem, fit) if linearisation is None else linearisation
    for _ in range(REFITS):
        better = refine(problem, fit, columns, linearisation)
        if better is fit:
            break
        fit, linearisation = better, linearise(problem, better)
    return fit, linearisation
