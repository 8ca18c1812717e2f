"""Select effects: search sets by beam search and refit them in the nonlinear model, until a test finds no more."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.beam import EffectSet, beam_search, best_parameters, ends_at_bound, gain_of, quadratic_cost
from driftjax.diagnosis.cross_validate import change_of, held_out_errors
from driftjax.diagnosis.fit import Fit, Problem, at_bound, evaluate_fit, evaluate_fits, linearise
from driftjax.diagnosis.gain import Errors
from driftjax.diagnosis.refine import refine, refine_together, refit_to_convergence
from driftjax.diagnosis.runs import Linearisation
from driftjax.diagnosis.score import Scores, pair_p_value, scores
from driftjax.logs.columns import MEASURED

LEVEL = 0.05  # family-wise rate at which chance may name an effect
PAIR_LEVEL = 0.01  # and a pair of effects whose single scores hide each other
MAX_EFFECTS = 8  # default limit of named effects
FIRST = (
    4  # effects that the test alone may name, beside those of pose and accelerations: later ones must predict better
)
STRIDE = 2  # effects that a set may have beyond those named before
REFITS = 3  # sets refitted to the end at each step, of twice as many begun
PARAMETER_PENALTY = 10.0  # required fall of the sum of squares per parameter, beside the test
MARGIN = 1.0  # by which a set must be better than the one before
ROUGH = 0.1  # fall of the cost below which the fit of a set is good enough to compare it: well below the margin
MIN_SIZE = 0.08  # size below which an effect is immaterial, in typical sizes


class Significance(NamedTuple):
    """Result of the significance test of one named effect."""

    p_value: float  # that chance gives any effect a score as large as its own beside the other members
    exploratory: bool  # whether it is not significant at the family-wise rate
    supported: bool  # whether it is significant at that rate or at the false discovery rate
    by_chance: float  # the p-value, or that of its own blocks (Bonferroni) where these agree though few say most


class Selection(NamedTuple):
    """Result of the search."""

    selected: tuple[int, ...]
    fit: Fit
    linearisation: Linearisation
    scores: Scores  # of what is left out
    base: Problem  # in which the observer of the nominal car follows it: the one searched in, where that does
    nominal: Fit
    nominal_scores: Scores  # of everything, at the nominal car
    free: int = FIRST  # effects that the test alone may name: the first ones, beside those of pose and accelerations
    dispersion: float | None = None  # of innovations, in whose units probabilities count costs; None: that of the fit
    replacements: dict[int, np.ndarray] | None = None  # costs (E,) with each effect in a member's place, where known
    significance: dict[int, Significance] | None = None  # of each member, where known


def penalised_cost(problem: Problem, fit: Fit, selected: tuple[int, ...]) -> float:
    """Return the cost of a hypothesis with the penalty of its parameters."""
    return fit.cost + PARAMETER_PENALTY * len(problem.columns(selected))


def is_material(problem: Problem, fit: Fit, effect: int) -> bool:
    """Return whether an effect differs materially from its start value."""
    return bool(np.abs((fit.theta - problem.start)[problem.columns((effect,))]).max() >= MIN_SIZE)


@dataclass(frozen=True)
class SelectionStep:
    """One stage of a search: a set of effects, fitted."""

    problem: Problem
    selected: tuple[int, ...]
    fit: Fit
    linearisation: Linearisation

    @cached_property
    def errors(self) -> Errors | None:
        """Return open-loop errors on parts left out of the fit; None where the log is too short."""
        return held_out_errors(self.problem, self.fit, self.linearisation, self.selected)

    def improves(self, before: "SelectionStep") -> bool:
        """Return whether left-out parts are predicted better than by `before`, or the log is too short to test."""
        return self.errors is None or before.errors is None or change_of(before.errors, self.errors).improves


def search(
    problem: Problem, start: Fit, seed: int = 0, selected: tuple[int, ...] = (), most: int = MAX_EFFECTS,
    report: Callable[[str], None] = lambda text: None, first: int = FIRST,
) -> Selection:  # fmt: skip
    """Name more effects, at most `most`, while the test rejects; replace, merge and drop them where that is better.

    Steps beyond the `first` effects must predict parts left out of the fit better.
    The search begins with the effects `selected` of `start`; without any, with those that pose and accelerations name.
    `report` is called with the effects named at each step.
    """
    start_at = linearise(problem, start)
    nominal = scores(problem, start_at, start.theta, (), seed)
    motion = () if selected else motion_effects(problem, start, start_at, seed, most)
    selected, free = selected or motion, first + len(motion)
    now = fitted(problem, start, selected, start_at)
    remaining = scores(problem, now.linearisation, now.fit.theta, selected, seed) if selected else nominal
    excluded: frozenset[int] = frozenset()
    known: dict[tuple[int, ...], float] = {}
    while True:
        if now.selected:
            report(f"naming: {', '.join(problem.effects[i].name for i in now.selected)}")
        rejected = remaining.p_value < LEVEL or pair_p_value(remaining.effective, remaining.seed) < PAIR_LEVEL
        more = STRIDE if rejected or bounded(now) else 0
        limit = min(len(now.selected) + more, max(most, len(now.selected)))
        new = extend_selection(now, (now.fit, now.linearisation), limit, free, excluded, known)
        if new is None and more and now.selected:  # a local optimum, perhaps: search about the nominal car too
            new = extend_selection(now, (start, start_at), limit, free, excluded, known)
        if new is None:
            new, excluded = drop_bounded(now, free, excluded, known)
        if new is None:
            fit, linearisation = refit_to_convergence(
                problem, now.fit, problem.columns(now.selected), now.linearisation
            )
            if fit is not now.fit:
                remaining = scores(problem, linearisation, fit.theta, now.selected, seed + len(now.selected))
            return Selection(now.selected, fit, linearisation, remaining, problem, start, nominal, free)
        now = new
        remaining = scores(problem, now.linearisation, now.fit.theta, now.selected, seed + len(now.selected))


def fitted(
    problem: Problem, start: Fit, selected: tuple[int, ...], linearisation: Linearisation | None = None
) -> SelectionStep:
    """Return the step with the effects `selected` fitted from `start`, whose `linearisation` may be known.

    To within the `MARGIN` between sets: only the last one must be fitted to the end.
    """
    fit, linearisation = refit_to_convergence(problem, start, problem.columns(selected), linearisation, MARGIN)
    return SelectionStep(problem, selected, fit, linearisation)


def bounded(step: SelectionStep) -> list[int]:
    """Return the selected effects that end at a bound."""
    ends = at_bound(step.problem, step.fit.theta)
    return [i for i in step.selected if ends[step.problem.columns((i,))].any()]


def extend_selection(
    now: SelectionStep, about: tuple[Fit, Linearisation], limit: int, free: int, excluded: frozenset[int],
    known: dict[tuple[int, ...], float],
) -> SelectionStep | None:  # fmt: skip
    """Return the best set without `excluded` effects that costs less than that of `now`, None where there is none.

    One with more than `free` effects that has more than before must predict parts left out of its fit better. The first
    effects need not: on an unstable drift even the true car predicts no better, and the test has its own error rate.
    """
    for effects, trial in better_sets(now, about, limit, excluded, known):
        after = fitted(now.problem, trial, effects)
        if len(effects) <= max(len(now.selected), free) or after.improves(now):
            return after
    return None


def drop_bounded(
    now: SelectionStep, free: int, excluded: frozenset[int], known: dict[tuple[int, ...], float]
) -> tuple[SelectionStep | None, frozenset[int]]:
    """Remove or replace an effect at its bound; return the step and the excluded effects.

    The data ask for more of such an effect than is plausible: it stands in for another cause, and stays only where
    parts left out of the fit are predicted better with it. None where all stay.
    """
    problem = now.problem
    for i in bounded(now) if now.errors is not None else []:
        rest = tuple(j for j in now.selected if j != i)
        theta = np.where(np.isin(np.arange(len(now.fit.theta)), problem.columns((i,))), problem.start, now.fit.theta)
        less, out = fitted(problem, evaluate_fit(problem, theta), rest), excluded | {i}
        if not now.improves(less):
            return less, out
        other = extend_selection(less, (less.fit, less.linearisation), len(now.selected), free, out, known)
        if other is not None and not now.improves(other):
            return other, out
    return None, excluded


def motion_effects(problem: Problem, start: Fit, linearisation: Linearisation, seed: int, most: int) -> tuple[int, ...]:
    """Return the effects that pose and accelerations name by themselves, to first order about the fit `start`.

    These know no car, only sensors and the road: their test has its own error rate.
    """
    if problem.motion is None:
        return ()
    e, J = (np.asarray(a)[:, :, len(MEASURED) :] for a in (linearisation.e, linearisation.J))
    sensors = linearisation._replace(e=e, J=J)
    model, selected = quadratic_cost(problem, start, sensors), ()
    while len(selected) < most:
        psi = best_parameters(model, selected)
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


def better_sets(
    now: SelectionStep, about: tuple[Fit, Linearisation], limit: int, excluded: frozenset[int],
    known: dict[tuple[int, ...], float],
) -> list[tuple[tuple[int, ...], Fit]]:  # fmt: skip
    """Return sets of at most `limit` effects with less penalised cost than `now` after refitting, the lowest first.

    Of the sets with a lower cost in the quadratic model `about` a fit, those with the lowest are refitted. `known`
    holds the penalised costs of sets refitted so far, which are not refitted again in vain.
    """
    problem, linearisation = now.problem, about[1]
    sets = promising_sets(now, about, limit, excluded)
    columns = [problem.columns(one.effects) for one in sets]
    begun = refine_together(problem, starts_of(problem, now.fit, sets), columns, linearisation, num=1)
    penalised = lambda item: penalised_cost(problem, item[1], item[0])
    cost_limit = penalised((now.selected, now.fit)) - MARGIN
    trials = sorted(((one.effects, trial) for one, trial in zip(sets, begun, strict=True)), key=penalised)[:REFITS]
    trials = [(effects, trial) for effects, trial in trials if known.get(effects, -np.inf) < cost_limit]
    columns = [problem.columns(effects) for effects, _ in trials]
    fits = refine_together(problem, [trial for _, trial in trials], columns, linearisation, tolerance=ROUGH)
    refitted = {}
    for (effects, _), fit in zip(trials, fits, strict=True):
        fit, left = refine_material(problem, fit, effects, linearisation)
        known[effects] = penalised((left, fit))
        refitted[left] = min(refitted.get(left, fit), fit, key=lambda one: one.cost)
    return sorted((item for item in refitted.items() if penalised(item) < cost_limit), key=penalised)


def promising_sets(
    now: SelectionStep, about: tuple[Fit, Linearisation], limit: int, excluded: frozenset[int]
) -> list[EffectSet]:
    """Return up to 3 `REFITS` sets without `excluded` effects, of a lower predicted penalised cost than that of `now`.

    They are the best of all in the model `about` a fit, then of each size, then of those with no parameter at a bound.
    Where that is not the fit of `now`, the cost of the present set is predicted by the same model.
    """
    problem = now.problem
    model = quadratic_cost(problem, *about)
    model = model._replace(columns=tuple(c[:0] if i in excluded else c for i, c in enumerate(model.columns)))
    penalty = lambda effects: PARAMETER_PENALTY * len(problem.columns(effects))
    there = about[0] is now.fit
    cost = now.fit.cost if there else model.cost - gain_of(model, best_parameters(model, now.selected))
    better = lambda one: model.cost - one.gain + penalty(one.effects) < cost + penalty(now.selected) - MARGIN
    sets = beam_search(model, limit, PARAMETER_PENALTY)
    sets = [one for one in sets if better(one) and set(one.effects) != set(now.selected)]
    firsts = [one for k, one in enumerate(sets) if len(one.effects) not in {len(s.effects) for s in sets[:k]}]
    inner = [one for one in sets if not ends_at_bound(model, one.psi).any()]
    leading = sets[:REFITS]
    for others in (firsts, inner[:REFITS]):
        leading += [one for one in others if all(one is not other for other in leading)][:REFITS]
    return leading


def starts_of(problem: Problem, fit: Fit, sets: list[EffectSet]) -> list[Fit]:
    """Return for each set the better of two starts: the minimum of its quadratic model, or its values in `fit`."""
    kept = [np.where(np.isin(problem.owner, one.effects), fit.theta, problem.start) for one in sets]
    known = [bool((theta == fit.theta).all()) for theta in kept]  # where the set holds all effects of `fit`
    new = [theta for theta, same in zip(kept, known, strict=True) if not same]
    fits = evaluate_fits(problem, [*(problem.start + one.psi for one in sets), *new])
    minima, others = fits[: len(sets)], iter(fits[len(sets) :])
    starts = [fit if same else next(others) for same in known]
    return [min(pair, key=lambda trial: trial.cost) for pair in zip(minima, starts, strict=True)]


def refine_material(
    problem: Problem, trial: Fit, effects: tuple[int, ...], linearisation: Linearisation
) -> tuple[Fit, tuple[int, ...]]:
    """Refine `trial` over `effects`, without those that turn out immaterial; return the fit and the effects left."""
    while True:
        trial = refine(problem, trial, problem.columns(effects), linearisation, tolerance=ROUGH)
        left = tuple(i for i in effects if is_material(problem, trial, i))
        if left == effects:
            return trial, effects
        theta, effects = problem.start.copy(), left
        theta[problem.columns(left)] = trial.theta[problem.columns(left)]
        trial = evaluate_fit(problem, theta)
