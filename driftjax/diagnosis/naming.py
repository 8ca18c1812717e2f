"""Name the effects of a problem: search for them, then replace each by a rival that is more probable in its place."""

from collections.abc import Callable

import numpy as np

from driftjax.diagnosis.beam import QuadraticCost, best_parameters, minimise_over, quadratic_cost
from driftjax.diagnosis.evidence import STRONG, significance
from driftjax.diagnosis.fit import Problem, evaluate_fit
from driftjax.diagnosis.multistart import search_multistart
from driftjax.diagnosis.refine import refine, refit_to_convergence
from driftjax.diagnosis.rivals import REFITTED, fit_dispersion, replaced, replacement_costs
from driftjax.diagnosis.score import scores
from driftjax.diagnosis.select import MAX_EFFECTS, PARAMETER_PENALTY, Selection
from driftjax.diagnosis.shapley import shapley_shares


def name_effects(
    problem: Problem, seed: int = 0, most: int = MAX_EFFECTS, report: Callable[[str], None] = lambda text: None
) -> tuple[Problem, Selection]:
    """Name effects so that none has a more probable rival; return the problem with its final noise, and the selection.

    Exploratory effects that the false discovery rate does not allow are left out again. `report` is called with
    the effects named at each step.
    """
    problem, selection = search_multistart(problem, seed, most, report)
    while True:
        selection, model, shares = with_significance(problem, prefer_probable(problem, selection, seed))
        if (weak := unsupported(selection, shares)) is None:
            return problem, selection
        selection = leave_out(problem, selection, model, (weak,), seed)


def with_significance(problem: Problem, selection: Selection) -> tuple[Selection, QuadraticCost, dict[int, float]]:
    """Return the selection with the significance of each effect, the quadratic cost about its fit, and the shares."""
    model = quadratic_cost(problem, selection.fit, selection.linearisation)
    shares = {i: one.share for i, one in shapley_shares(problem, selection).items()}
    return selection._replace(significance=significance(problem, selection, model, shares)), model, shares


def unsupported(selection: Selection, shares: dict[int, float]) -> int | None:
    """Return the exploratory effect with the smallest share that the false discovery rate rejects; None without one.

    It is left out before the others are tested again. A single effect is never one.
    """
    weak = [i for i, one in (selection.significance or {}).items() if not one.supported]
    return min(weak, key=lambda i: shares[i]) if weak and len(shares) > 1 else None


def leave_out(
    problem: Problem, selection: Selection, model: QuadraticCost, effects: tuple[int, ...], seed: int
) -> Selection:
    """Return the selection without `effects`, the others refitted; `model` is the quadratic one about its fit."""
    rest = tuple(i for i in selection.selected if i not in effects)
    return refitted(problem, selection, rest, best_parameters(model, rest), seed)


def leave_out_unconfirmed(
    problem: Problem, selection: Selection, share: float, found_again: tuple[str, ...], seed: int
) -> tuple[Selection, tuple[str, ...]]:
    """Leave out effects that neither predictions nor a part of the runs confirm; return the selection, and their names.

    `share` is that of the excess error which the named effects remove, NaN where it is in doubt that there is any, and
    `found_again` are the effects named from the part of the runs alone. Where both say nothing, only its p-value speaks
    for an effect, and by that chance names one in one log of twenty; one below `STRONG` is enough. Where a rival is
    then more probable than an effect that stays, the two names contradict each other: it is left out too.

    Where the drive force was inferred beside the sideslip, its errors are the same in all runs and no chance: there
    predictions alone confirm.
    """
    names = {i: problem.effects[i].name for i in selection.selected}
    inferred = problem.data.force_inferred
    weak = [i for i, one in (selection.significance or {}).items() if inferred or one.by_chance > STRONG]
    unconfirmed = tuple(i for i in weak if inferred or names[i] not in found_again)
    if not (np.isnan(share) and unconfirmed):
        return selection, ()
    model, costs, left = quadratic_cost(problem, selection.fit, selection.linearisation), None, selection
    while unconfirmed:
        left = leave_out(problem, left, model, unconfirmed, seed)
        model, costs = rival_costs(problem, left)
        rival = most_probable_rival(problem, left, costs) if left.selected else None
        unconfirmed = rival[:1] if rival and rival[0] in weak else ()
    gone = tuple(name for i, name in names.items() if i not in left.selected)
    return left._replace(replacements=costs), gone


def rival_costs(
    problem: Problem, selection: Selection, refitted: int = REFITTED
) -> tuple[QuadraticCost, dict[int, np.ndarray]]:
    """Return the quadratic cost about the fit, and for each member the costs (E,) with every effect in its place."""
    model = quadratic_cost(problem, selection.fit, selection.linearisation)
    return model, replacement_costs(problem, selection, model, selection.selected, refitted)


def prefer_probable(problem: Problem, selection: Selection, seed: int = 0) -> Selection:
    """Replace effects by rivals until none has a more probable one.

    The search compares costs as if innovations were independent, probabilities count them in units of their
    dispersion. That of the first fit is kept, so that every replacement lowers the penalised cost and the loop ends.
    Rivals that are only credible are refitted where none that is predicted to be more probable is.
    """
    if not selection.selected:
        return selection
    selection = selection._replace(dispersion=fit_dispersion(problem, selection))
    while True:
        for refitted in (0, REFITTED):
            model, costs = rival_costs(problem, selection, refitted)
            if (swap := most_probable_rival(problem, selection, costs)) is not None:
                selection = replace_effect(problem, selection, model, *swap, seed)
                break
        else:
            return selection._replace(replacements=costs)


def most_probable_rival(
    problem: Problem, selection: Selection, replacements: dict[int, np.ndarray]
) -> tuple[int, int] | None:
    """Return the (member, rival) whose exchange gives the most probable hypothesis; None if none is more probable.

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
    selected = replaced(selection.selected, member, rival)
    start = minimise_over(model, selected)
    assert start is not None, "a credible rival has a minimum of its own"
    return refitted(problem, selection, selected, start.psi, seed)


def refitted(
    problem: Problem, selection: Selection, selected: tuple[int, ...], psi: np.ndarray, seed: int
) -> Selection:
    """Return the selection with the effects `selected` in place of its own, fitted from `psi` (K,)."""
    columns = problem.columns(selected)
    fit = refine(problem, evaluate_fit(problem, problem.start + psi), columns, selection.linearisation)
    fit, linearisation = refit_to_convergence(problem, fit, columns)
    last = scores(problem, linearisation, fit.theta, selected, seed + len(selected))
    return selection._replace(
        selected=selected, fit=fit, linearisation=linearisation, scores=last, replacements=None, significance=None
    )
