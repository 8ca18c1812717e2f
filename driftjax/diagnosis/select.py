"""Select effects: forward, swap and backward steps between refits of the whole nonlinear model."""

from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.fit import Fit, Problem, evaluate, linearise, refine, refit_to_convergence
from driftjax.diagnosis.runs import Linearisation
from driftjax.diagnosis.score import Scores, scores

LEVEL = 0.05  # family-wise rate at which chance may name an effect
MAX_EFFECTS = 4  # default limit of named effects
REFITS = 6  # candidates refitted at each step
PARAMETER_PENALTY = 10.0  # required fall of the sum of squares per parameter, beside the test
MIN_SIZE = 0.08  # size below which an effect is immaterial, in typical sizes


class Selection(NamedTuple):
    """Result of the search."""

    selected: tuple[int, ...]
    fit: Fit
    linearisation: Linearisation
    scores: Scores  # of what is left out
    base: Problem  # in which the observer of the nominal car follows it: the one searched in, where that does
    nominal: Fit
    nominal_scores: Scores  # of everything, at the nominal car


def penalised_cost(problem: Problem, fit: Fit, selected: tuple[int, ...]) -> float:
    """Return the cost of a hypothesis with the penalty of its parameters."""
    return fit.cost + PARAMETER_PENALTY * len(problem.columns(selected))


def is_material(problem: Problem, fit: Fit, effect: int) -> bool:
    """Return whether an effect differs materially from its start value."""
    return bool(np.abs((fit.theta - problem.start)[problem.columns((effect,))]).max() >= MIN_SIZE)


def add_best_effect(
    problem: Problem, fit: Fit, selected: tuple[int, ...], at: Linearisation, gain: np.ndarray
) -> tuple[tuple, Fit]:
    """Add to `selected` the effect whose refit has the least penalised cost; none where the cost does not fall.

    Candidates by the `gain` (E,) they promise at the fit, linearised in `at`; after one step all but the best three
    are given up.
    """
    worth = gain - PARAMETER_PENALTY * np.array([len(problem.columns((i,))) for i in range(len(gain))])
    order = [int(i) for i in np.argsort(-worth)[:REFITS] if gain[i] > 0.2 * gain.max()]
    grown = [(*selected, one) for one in order if one not in selected]
    trials = [(refine(problem, fit, problem.columns(new), at, num=1), new) for new in grown]
    trials.sort(key=lambda item: penalised_cost(problem, *item))
    trials = [(refine(problem, trial, problem.columns(new), at), new) for trial, new in trials[:3]]
    trials = [(trial, new) for trial, new in trials if is_material(problem, trial, new[-1])]
    trial, new = min([*trials, (fit, selected)], key=lambda item: penalised_cost(problem, *item))
    return new, trial


def search(
    problem: Problem, start: Fit, seed: int = 0, selected: tuple[int, ...] = (), most: int = MAX_EFFECTS
) -> Selection:
    """Add effects while the test rejects and the penalised cost falls, at most `most`; swap and prune after each.

    The search begins with the effects `selected` of `start`.
    """
    fit, at = refit_to_convergence(problem, start, problem.columns(selected))
    remaining = first = scores(problem, at, fit.theta, selected, seed)
    while len(selected) < most and remaining.p_value < LEVEL:
        grown, trial = add_best_effect(problem, fit, selected, at, remaining.gain)
        new, trial = prune(problem, *swap(problem, grown, trial))
        trial, there = refit_to_convergence(problem, trial, problem.columns(new))
        if penalised_cost(problem, trial, new) >= penalised_cost(problem, fit, selected):
            break
        selected, fit, at = new, trial, there
        remaining = scores(problem, at, fit.theta, selected, seed + len(selected))
    return Selection(selected, fit, at, remaining, problem, start, first)


def refit_without(
    problem: Problem, fit: Fit, selected: tuple[int, ...], gone: int, near: Linearisation
) -> tuple[tuple[int, ...], Fit]:
    """Refit the hypothesis without the effect `gone`; `near` are the derivatives of a nearby fit."""
    theta, rest = fit.theta.copy(), tuple(i for i in selected if i != gone)
    theta[problem.columns((gone,))] = problem.start[problem.columns((gone,))]
    return rest, refine(problem, evaluate(problem, theta), problem.columns(rest), near)


def swap(problem: Problem, selected: tuple[int, ...], fit: Fit) -> tuple[tuple[int, ...], Fit]:
    """Replace each earlier effect by the best other one, where that lowers the penalised cost."""
    for old in selected[:-1]:
        rest, base = refit_without(problem, fit, selected, old, linearise(problem, fit))
        base, at = refit_to_convergence(problem, base, problem.columns(rest))
        remaining = scores(problem, at, base.theta, rest, 0)
        new, trial = add_best_effect(problem, base, rest, at, remaining.gain)
        if penalised_cost(problem, trial, new) < penalised_cost(problem, fit, selected) - 1.0:
            selected, fit = new, trial
    return selected, fit


def prune(problem: Problem, selected: tuple[int, ...], fit: Fit) -> tuple[tuple[int, ...], Fit]:
    """Remove effects that are immaterial or do not lower the penalised cost, the least useful first."""
    while selected:
        at, trials = linearise(problem, fit), []
        for one in selected:
            rest, trial = refit_without(problem, fit, selected, one, at)
            trials.append(
                (penalised_cost(problem, trial, rest) if is_material(problem, fit, one) else -np.inf, rest, trial)
            )
        loss, rest, trial = min(trials, key=lambda item: item[0])
        if loss >= penalised_cost(problem, fit, selected):
            break
        selected, fit = rest, trial
    return selected, fit
