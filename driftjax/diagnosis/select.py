"""Select effects: sets from a beam search, refitted in the whole nonlinear model, while a test finds something left."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.beam import EffectSet, beam_search, gain_of, minimise, quadratic_cost
from driftjax.diagnosis.fit import Fit, Problem, at_bound, evaluate, linearise, refine, refit_to_convergence
from driftjax.diagnosis.runs import Linearisation
from driftjax.diagnosis.score import Scores, pair_p_value, scores
from driftjax.logs.columns import MEASURED

LEVEL = 0.05  # family-wise rate at which chance may name an effect
PAIR_LEVEL = 0.01  # and a pair of effects whose single scores hide each other
MAX_EFFECTS = 8  # default limit of named effects
STRIDE = 2  # effects that a set may have beyond those named before
REFITS = 3  # sets refitted to the end at each step, of twice as many begun
PARAMETER_PENALTY = 10.0  # required fall of the sum of squares per parameter, beside the test
MARGIN = 1.0  # by which a set must be better than the one before
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
    dispersion: float | None = None  # of innovations, in whose units probabilities count costs; None: that of the fit
    replacements: dict[int, np.ndarray] | None = None  # costs (E,) with each effect in a member's place, where known


def penalised_cost(problem: Problem, fit: Fit, selected: tuple[int, ...]) -> float:
    """Return the cost of a hypothesis with the penalty of its parameters."""
    return fit.cost + PARAMETER_PENALTY * len(problem.columns(selected))


def is_material(problem: Problem, fit: Fit, effect: int) -> bool:
    """Return whether an effect differs materially from its start value."""
    return bool(np.abs((fit.theta - problem.start)[problem.columns((effect,))]).max() >= MIN_SIZE)


def search(
    problem: Problem, start: Fit, seed: int = 0, selected: tuple[int, ...] = (), most: int = MAX_EFFECTS,
    report: Callable[[str], None] = lambda text: None,
) -> Selection:  # fmt: skip
    """Name more effects, at most `most`, while the test rejects; replace, merge and drop them wherever that is better.

    The search begins with the effects `selected` of `start`; without any, with those that pose and accelerations name.
    `report` hears of the effects named at each step.
    """
    first_at = linearise(problem, start)
    first = scores(problem, first_at, start.theta, (), seed)
    selected = selected or motion_effects(problem, start, first_at, seed, most)
    fit, at = refit_to_convergence(problem, start, problem.columns(selected), first_at)
    remaining = scores(problem, at, fit.theta, selected, seed) if selected else first
    while True:
        if selected:
            report(f"naming: {', '.join(problem.effects[i].name for i in selected)}")
        rejected = remaining.p_value < LEVEL or pair_p_value(remaining.effective, remaining.seed) < PAIR_LEVEL
        short = at_bound(problem, fit.theta)[problem.columns(selected)].any()  # of what it stands for
        more = STRIDE if rejected or short else 0
        limit = min(len(selected) + more, max(most, len(selected)))
        new, trial = best_set(problem, fit, selected, (fit, at), limit)
        if new == selected and selected:  # a local optimum, perhaps: sets that the nominal car promises
            new, trial = best_set(problem, fit, selected, (start, first_at), limit)
        if new == selected:
            return Selection(selected, fit, at, remaining, problem, start, first)
        selected = new
        fit, at = refit_to_convergence(problem, trial, problem.columns(selected))
        remaining = scores(problem, at, fit.theta, selected, seed + len(selected))


def motion_effects(problem: Problem, start: Fit, at: Linearisation, seed: int, most: int) -> tuple[int, ...]:
    """Return the effects that pose and accelerations name by themselves, to first order about the fit `start`.

    These know no car, only sensors and the road: their test has its own error rate.
    """
    if problem.motion is None:
        return ()
    e, J = (np.asarray(a)[:, :, len(MEASURED) :] for a in (at.e, at.J))
    sensors = at._replace(e=e, J=J)
    model, selected = quadratic_cost(problem, start, sensors), ()
    while len(selected) < most:
        psi = minimise(model, selected)
        left = scores(problem, sensors._replace(e=e - J @ psi), start.theta + psi, selected, seed + len(selected))
        if left.p_value >= LEVEL:
            break
        sets = beam_search(model, len(selected) + 1, PARAMETER_PENALTY)
        sizes = lambda one: np.array([np.abs(one.psi[model.columns[i]]).max() for i in one.effects])
        sets = [one for one in sets if (sizes(one) >= MIN_SIZE).all()]
        if not sets or sets[0].effects == selected:
            break
        selected = sets[0].effects
    return selected


def best_set(
    problem: Problem, fit: Fit, selected: tuple[int, ...], about: tuple[Fit, Linearisation], limit: int
) -> tuple[tuple[int, ...], Fit]:
    """Return the set of at most `limit` effects with the least penalised cost after refitting, and its fit.

    Of the sets that promise less than `selected` in the quadratic model `about` a fit, those that promise least are
    refitted; `selected` and its `fit` come back where none of them is better.
    """
    trials, at = [], about[1]
    for one in promising_sets(problem, fit, selected, about, limit):
        trial = refine(problem, step_to(problem, fit, one), problem.columns(one.effects), at, num=1)
        trials.append((trial, one.effects))
    trials.sort(key=lambda item: penalised_cost(problem, *item))
    refitted = [(fit, selected)]
    for trial, effects in trials[:REFITS]:
        refitted.append(refine_material(problem, trial, effects, at))
    best, effects = min(refitted, key=lambda item: penalised_cost(problem, *item))
    better = penalised_cost(problem, best, effects) < penalised_cost(problem, fit, selected) - MARGIN
    return (effects, best) if better else (selected, fit)


def promising_sets(
    problem: Problem, fit: Fit, selected: tuple[int, ...], about: tuple[Fit, Linearisation], limit: int
) -> list[EffectSet]:
    """Return up to 3 `REFITS` sets that promise to be better than `selected` in the model `about` a fit.

    They are the best of all, then of each size, then of those with no parameter at a bound. About another fit than
    the present one, what `selected` costs is what the model there says of it.
    """
    model = quadratic_cost(problem, *about)
    price = lambda effects: PARAMETER_PENALTY * len(problem.columns(effects))
    now = fit.cost if about[0] is fit else model.cost - gain_of(model, minimise(model, selected))
    better = lambda one: model.cost - one.gain + price(one.effects) < now + price(selected) - MARGIN
    sets = beam_search(model, limit, PARAMETER_PENALTY)
    sets = [one for one in sets if better(one) and set(one.effects) != set(selected)]
    firsts = [one for k, one in enumerate(sets) if len(one.effects) not in {len(s.effects) for s in sets[:k]}]
    inner = [one for one in sets if not at_bound(problem, problem.start + one.psi).any()]
    leading = sets[:REFITS]
    for others in (firsts, inner):
        leading += [one for one in others if all(one is not other for other in leading)][:REFITS]
    return leading


def step_to(problem: Problem, fit: Fit, one: EffectSet) -> Fit:
    """Return the better of two starts for refitting a set: the model's minimum, and `fit` without other effects."""
    columns = problem.columns(one.effects)
    kept = problem.start.copy()
    kept[columns] = fit.theta[columns]
    return min((evaluate(problem, theta) for theta in (problem.start + one.psi, kept)), key=lambda trial: trial.cost)


def refine_material(
    problem: Problem, trial: Fit, effects: tuple[int, ...], at: Linearisation
) -> tuple[Fit, tuple[int, ...]]:
    """Refine `trial` over `effects`, without those that turn out immaterial; return the fit and the effects left."""
    while True:
        trial = refine(problem, trial, problem.columns(effects), at)
        left = tuple(i for i in effects if is_material(problem, trial, i))
        if left == effects:
            return trial, effects
        theta, effects = problem.start.copy(), left
        theta[problem.columns(left)] = trial.theta[problem.columns(left)]
        trial = evaluate(problem, theta)
