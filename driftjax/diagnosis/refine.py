"""Fit hypotheses by Gauss-Newton on the active parameters, several of them in one batch."""

from collections.abc import Sequence

import numpy as np

from driftjax.diagnosis.fit import Fit, Problem, evaluate_fits, information, linearise
from driftjax.diagnosis.quadratic import minimise_quadratic
from driftjax.diagnosis.runs import Linearisation

STEP_LENGTHS = (0.5, 0.25, 0.1)  # of Gauss-Newton steps tried where the whole one does not lower the cost
TOLERANCE = 0.01  # fall of the cost below which a fit is done: a tenth of a standard deviation
REFITS = 6  # refinements, each about derivatives of its own, at most
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

    Each until its cost falls by less than `tolerance`. Derivatives are those of a fit `near` them, corrected by what
    every step shows of them: own ones take several times as long as the innovations, and are computed only where what
    those miss of a step is more than what they predict.
    """
    fits, own, J = list(fits), {}, np.asarray(near.J)
    going = list(range(len(fits)))
    for k in range(num):
        of = lambda i: own[i] if i in own else J[..., columns[i]]
        each = ((i, gauss_newton_goal(problem, fits[i], columns[i], of(i), tolerance)) for i in going)
        goals = {i: goal for i, goal in each if goal is not None}
        trials = _line_search(problem, [fits[i] for i in goals], list(goals.values()))
        going = []
        for i, trial in zip(goals, trials, strict=True):
            if k + 1 < num and fits[i].cost - trial.cost > tolerance:
                corrected = secant_derivatives(problem, of(i), columns[i], fits[i], trial, near.lost)
                own[i] = np.asarray(linearise(problem, trial).J)[..., columns[i]] if corrected is None else corrected
                going.append(i)
            fits[i] = trial
    return fits


def secant_derivatives(
    problem: Problem, J: np.ndarray, columns: np.ndarray, before: Fit, after: Fit, lost: np.ndarray | None = None
) -> np.ndarray | None:
    """Return the derivatives `J` (P, T, c, k) with the least change that explains the step between two fits.

    The update of Broyden (1965, Eq. 4.5) with the information as metric of the steps; none at samples that are `lost`.
    None where what `J` misses of the step is more than what it predicts.
    """
    step = (after.theta - before.theta)[columns]
    predicted = J @ step
    missing = before.e - after.e - predicted
    if lost is not None:
        missing = np.where(lost[..., None], 0.0, missing)
    if np.sum(missing**2) > np.sum(predicted**2):
        return None
    weighted = (information(J) + problem.prior[np.ix_(columns, columns)]) @ step
    return J + missing[..., None] * (weighted / (step @ weighted))


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
    problem: Problem, fit: Fit, columns: np.ndarray, linearisation: Linearisation | None = None,
    tolerance: float = TOLERANCE,
) -> tuple[Fit, Linearisation]:  # fmt: skip
    """Refine `fit` over `columns` until its own derivatives promise less than `tolerance`; return it linearised.

    `linearisation` is that at the given `fit`, where it is known.
    """
    linearisation = linearise(problem, fit) if linearisation is None else linearisation
    for _ in range(REFITS):
        better = refine(problem, fit, columns, linearisation, tolerance=tolerance)
        if better is fit:
            break
        fit, linearisation = better, linearise(problem, better)
    return fit, linearisation
