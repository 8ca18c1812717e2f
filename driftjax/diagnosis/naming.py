"""Name the effects of a problem: search for them, then replace each by a rival that is more probable in its place."""

from collections.abc import Callable

import numpy as np

from driftjax.diagnosis.beam import QuadraticCost, minimise_over, quadratic_cost
from driftjax.diagnosis.evidence import fit_dispersion, replacement_costs
from driftjax.diagnosis.fit import Problem, evaluate, refine, refit_to_convergence
from driftjax.diagnosis.multistart import search_multistart
from driftjax.diagnosis.score import scores
from driftjax.diagnosis.select import MAX_EFFECTS, PARAMETER_PENALTY, Selection


def name_effects(
    problem: Problem, seed: int = 0, most: int = MAX_EFFECTS, report: Callable[[str], None] = lambda text: None
) -> tuple[Problem, Selection]:
    """Search for effects, none of them less probable than a rival; return the problem searched in and the selection.

    `report` hears of the effects named at each step.
    """
    problem, selection = search_multistart(problem, seed, most, report)
    return problem, prefer_probable(problem, selection, seed)


def prefer_probable(problem: Problem, selection: Selection, seed: int = 0) -> Selection:
    """Replace effects by rivals until none has a more probable one.

    The search compares costs as if innovations were independent, probabilities count them in units of their
    dispersion. That of the first fit is kept, so that every replacement lowers the price and the loop ends.
    """
    if not selection.selected:
        return selection
    selection = selection._replace(dispersion=fit_dispersion(problem, selection))
    while True:
        model = quadratic_cost(problem, selection.fit, selection.linearisation)
        costs = {member: replacement_costs(problem, selection, model, member) for member in selection.selected}
        if (swap := most_probable_rival(problem, selection, costs)) is None:
            return selection._replace(replacements=costs)
        selection = replace_effect(problem, selection, model, *swap, seed)


def most_probable_rival(
    problem: Problem, selection: Selection, replacements: dict[int, np.ndarray]
) -> tuple[int, int] | None:
    """Return the member and the rival in its place that make the most probable hypothesis; None where all may stay.

    `replacements` holds the costs (E,) with each effect in the place of a member.
    """
    sizes, dispersion = np.bincount(problem.owner), fit_dispersion(problem, selection)
    least, swap = 0.0, None
    for member, costs in replacements.items():
        rise = (costs - costs[member]) / dispersion + PARAMETER_PENALTY * (sizes - sizes[member])
        if rise.min() < least:
            least, swap = float(rise.min()), (member, int(rise.argmin()))
    return swap


def replace_effect(
    problem: Problem, selection: Selection, model: QuadraticCost, member: int, rival: int, seed: int
) -> Selection:
    """Return the selection with `rival` in the place of `member`, all effects refitted."""
    selected = tuple(sorted((*(i for i in selection.selected if i != member), rival)))
    start, columns = minimise_over(model, selected), problem.columns(selected)
    assert start is not None, "a credible rival has a minimum of its own"
    fit = refine(problem, evaluate(problem, problem.start + start.psi), columns, selection.linearisation)
    fit, at = refit_to_convergence(problem, fit, columns)
    last = scores(problem, at, fit.theta, selected, seed + len(selected))
    return selection._replace(selected=selected, fit=fit, linearisation=at, scores=last)
