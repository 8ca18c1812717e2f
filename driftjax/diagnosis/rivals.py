"""Rivals of named effects: what the fit costs with another effect in the place of one, and how probable that is."""

import numpy as np

from driftjax.diagnosis.beam import (
    QuadraticCost,
    best_parameters,
    ends_at_bound,
    gain_of,
    gains_of_adding,
    minimise_over,
)
from driftjax.diagnosis.fit import Problem, at_bound, evaluate_fits
from driftjax.diagnosis.refine import refine_together
from driftjax.diagnosis.score import overdispersion
from driftjax.diagnosis.select import PARAMETER_PENALTY, ROUGH, Selection

CREDIBLE = 0.03  # probability from which a rival is refitted
REFITTED = 4  # rivals refitted at most
MODEL_ERROR = 0.2  # of what a member is worth, by which the quadratic model may put the cost of a rival too high
BOUNDED = 12  # rivals whose bounds are looked at
LATE_ALIKE = ("steer_delay", "channel_delay")  # see `share_among_alike`


def effect_probabilities(problem: Problem, selection: Selection, model: QuadraticCost, member: int) -> np.ndarray:
    """Return the probabilities (E,) that `member` or another effect acts in its place."""
    sizes = np.bincount(problem.owner)
    known = selection.replacements
    costs = (known or replacement_costs(problem, selection, model, (member,)))[member]
    share = hypothesis_probabilities(costs, sizes, fit_dispersion(problem, selection))
    return share_among_alike(problem, selection.selected, selection.fit.theta, member, share)


def share_among_alike(
    problem: Problem, selected: tuple[int, ...], theta: np.ndarray, member: int, share: np.ndarray
) -> np.ndarray:
    """Return the probabilities `share` (E,), made equal for `member` and the effect that is the same model, if any.

    `theta` (K,) are the parameters of the effects `selected`, or their differences between two logs. A drive force that
    was estimated from the speed is as late as that. One delay of all sensors then is one of the steering: where their
    costs differ, it is because gains and the ends of runs are not shifted with the measurements.
    """
    data, names = problem.data, [effect.name for effect in problem.effects]
    if data.force_known or not {*LATE_ALIKE} <= {*names} or names[member] not in LATE_ALIKE:
        return share
    steering, sensors = map(names.index, LATE_ALIKE)
    if {steering, sensors} <= {*selected}:  # one beside the other, in whose place it cannot act
        return share
    late = theta[problem.columns((sensors,))][[True, not data.skip, True]]
    common = np.mean(late)
    if member == steering or np.all(np.sign(common) * late > np.abs(common) / 2):
        share = share.copy()
        share[[steering, sensors]] = share[[steering, sensors]].mean()
    return share


def replacement_costs(
    problem: Problem, selection: Selection, model: QuadraticCost, members: tuple[int, ...], refitted: int = REFITTED
) -> dict[int, np.ndarray]:
    """Return for each of `members` the cost (E,) with every effect in its place, infinite for the other members.

    They follow from the quadratic model about the fit; at most `refitted` rivals are refitted, the credible ones and
    those that the model, which errs the more the further it reaches, may put too high (`MODEL_ERROR`). In any case
    refitted is what is predicted to be more probable than the member. Infinite too for what ends at its bound.
    """
    if not members:  # whose dispersion would be that of nothing
        return {}
    rest = {member: tuple(i for i in selection.selected if i != member) for member in members}
    costs = {member: model.cost - rival_gains(model, rest[member]) for member in members}
    near = {}
    for member in members:
        without = model.cost - gain_of(model, best_parameters(model, rest[member]))
        near[member] = costs[member] - selection.fit.cost < MODEL_ERROR * (without - selection.fit.cost)
        costs[member][member] = selection.fit.cost
    sizes, excess = np.bincount(problem.owner), fit_dispersion(problem, selection)
    known: dict[int, list[int]] = {member: [] for member in members}
    while True:
        share = {member: hypothesis_probabilities(costs[member], sizes, excess) for member in members}
        new = [(i, j) for i in members for j in _rivals_to_refit(share[i], near[i], i, known[i], refitted)]
        if not new:
            return costs
        for member, rival in new:
            known[member].append(rival)
            costs[member][rival] = np.inf
        minima = [(member, rival, minimise_over(model, (*rest[member], rival))) for member, rival in new]
        sets = [(member, rival, one) for member, rival, one in minima if one is not None]
        starts = evaluate_fits(problem, [problem.start + one.psi for *_, one in sets])
        columns = [problem.columns(one.effects) for *_, one in sets]
        fits = refine_together(problem, starts, columns, selection.linearisation, tolerance=ROUGH)
        for (member, rival, _), fit in zip(sets, fits, strict=True):
            if not at_bound(problem, fit.theta)[problem.columns((rival,))].any():
                costs[member][rival] = fit.cost


def _rivals_to_refit(share: np.ndarray, near: np.ndarray, member: int, known: list[int], refitted: int) -> list[int]:
    """Return the rivals to refit by their probabilities `share` (E,), but those `known`, the most probable first.

    They are all that are more probable than `member`, and those that are credible or `near` (E,) to it until `refitted`
    are known.
    """
    order = [int(i) for i in np.argsort(-share) if i != member and i not in known]
    more = [i for i in order if share[i] > share[member]]
    credible = [i for i in order if share[i] <= share[member] and (share[i] > CREDIBLE or near[i])]
    return more + credible[: max(refitted - len(known) - len(more), 0)]


def replaced(selected: tuple[int, ...], member: int, rival: int) -> tuple[int, ...]:
    """Return the set `selected` with `rival` in the place of `member`."""
    return tuple(sorted({*selected} - {member} | {rival}))


def rival_gains(model: QuadraticCost, rest: tuple[int, ...]) -> np.ndarray:
    """Return the fall of the cost (E,) from the effects `rest` together with each other effect in turn, within bounds.

    -inf for members, and for what ends at its bound, which is no explanation.
    """
    promised = gains_of_adding(model, rest) + gain_of(model, best_parameters(model, rest))
    for i in np.argsort(-promised)[:BOUNDED]:  # bounds only make a gain less
        if np.isfinite(promised[i]):
            one = minimise_over(model, (*rest, int(i)))
            inner = one and not ends_at_bound(model, one.psi)[model.columns[int(i)]].any()
            promised[i] = one.gain if one and inner else -np.inf
    return promised


def fit_dispersion(problem: Problem, selection: Selection) -> float:
    """Return the dispersion of the selection; if it has none, the `overdispersion` of its effects at the fit."""
    if selection.dispersion is not None:
        return selection.dispersion
    return overdispersion(selection.scores.H, selection.scores.blocks, problem.columns(selection.selected))


def hypothesis_probabilities(costs: np.ndarray, sizes: np.ndarray, excess: float) -> np.ndarray:
    """Return the probabilities (n,) of hypotheses with the `costs` (n,) and numbers of parameters `sizes` (n,).

    Each weighs exp(-penalised cost / 2), as in the Bayesian information criterion (Schwarz 1978), costs in units of the
    `excess` of their dispersion over that of noise (QAIC; Burnham and Anderson 2002, Sec. 2.5): innovations that
    depend on each other would else count as more data than they are.
    """
    penalised = costs / excess + PARAMETER_PENALTY * sizes
    weight = np.exp(-0.5 * (penalised - penalised.min()))
    return weight / weight.sum()
