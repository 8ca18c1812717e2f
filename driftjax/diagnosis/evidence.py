"""Uncertainty of named effects: intervals of their parameters, and the probability of each against its rivals."""

from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc

from driftjax.diagnosis.beam import QuadraticCost, best_parameters, quadratic_cost
from driftjax.diagnosis.curves import AxleCurve, axle_curve
from driftjax.diagnosis.fit import Problem, at_bound, information
from driftjax.diagnosis.prediction_fit import PredictionFit
from driftjax.diagnosis.rivals import effect_probabilities
from driftjax.diagnosis.score import (
    CONDITION,
    NONE,
    ParameterSpread,
    Scores,
    benjamini_yekutieli,
    half_widths_from,
    partial_out,
    scores,
    spread_of,
)
from driftjax.diagnosis.select import LEVEL, Selection, Significance
from driftjax.diagnosis.shapley import ErrorShare, shapley_shares
from driftjax.vehicle.effect.families import FAMILY_OF

INVARIANCE_LEVEL = 0.001  # probability below which an effect that differs between runs is no cause but stands for one
DISCOVERY_RATE = 0.1  # share of exploratory effects that may be false
STRONG = 0.001  # p-value by its own blocks, for all effects together, from which an effect needs no other support
RIVAL_PROBABILITY = 0.01  # probability from which a rival is reported
SURE_PROBABILITY = 0.95  # probability from which one name stands alone
SMALL_SHARE = 0.03  # of what all named effects explain, below which a name must be sure to be claimed
FIRM = 4.0  # half-widths of its interval that a size must exceed where the force was inferred beside the sideslip
TOLERANCE = 0.2  # standard deviation between runs, over its size, by which a cause may vary
MIN_SHARE = 0.01  # of the information on a parameter that a run must have to count in the test of invariance
CONFUSABLE_COSINE = 0.95  # cosine of two effects' signatures from which the data hardly tell them apart


class Cause(NamedTuple):
    """One named effect, in typical sizes."""

    effect: int
    theta: np.ndarray  # (k,) in typical sizes
    half_width: np.ndarray  # (k,) of the 95 % interval
    probability: float
    rivals: dict[int, float]  # effects that might act in its place, with their probabilities
    confusable: tuple[int, ...]  # effects whose signature is nearly the same
    invariance: float  # probability that chance makes its size differ as much between runs; 1 for a single run
    p_value: float  # that chance gives any effect a score as large as its own beside the other causes
    family_probability: float  # that it or another effect of its family acts
    error_share: ErrorShare  # of what all named effects explain
    at_bound: np.ndarray  # (k,) whether these data ask for more than the parameter may be
    exploratory: bool = False  # not significant, or it stands for something else
    curve: AxleCurve | None = None  # of the axle whose side force it frees from the formula

    @property
    def varies(self) -> bool:
        """Return whether its size differs from run to run; that of a cause does not."""
        return self.invariance < INVARIANCE_LEVEL

    @property
    def stands_in(self) -> bool:
        """Return whether it imitates another cause: it ends at its bound, or its size differs from run to run."""
        return bool(self.at_bound.any()) or self.varies

    @property
    def small_and_unsure(self) -> bool:
        """Return whether it explains little of the error and is not the only effect that may explain it."""
        return self.error_share.share < SMALL_SHARE and self.probability < SURE_PROBABILITY


class NamedEffect(NamedTuple):
    """One named effect in SI, as diagnosis.json holds it."""

    effect: str
    probability: float  # that it rather than a rival acts
    p_value: float  # of its own score beside the other causes
    parameters: dict[str, dict[str, Any]]  # name -> value, ci95 (low, high), unit, at_bound; SI
    invariance: float  # probability that chance makes its size differ as much between runs; 1 for a single run
    confusable_with: list[str]  # effects that these data hardly tell from it
    rivals: dict[str, float]  # effects that might act in its place, with their probabilities
    family: str  # part of the car or of the measurement that it belongs to
    family_probability: float  # that it or another effect of that family acts
    share: float  # of what all named effects explain together (Shapley 1953)
    share_ci95: list[float]
    exploratory: bool  # not significant at the family-wise rate of 5 %, or at its bound, or not the same in all runs
    curve: dict[str, Any] | None  # side force over slip where it is of free form, as `AxleCurve`


def named_effects(problem: Problem, causes: list[Cause]) -> tuple[NamedEffect, ...]:
    """Return the named effects with their parameters in SI."""
    scale = np.asarray(problem.model.scale)
    selection = []
    for cause in causes:
        effect, columns = problem.effects[cause.effect], problem.columns((cause.effect,))
        rows = zip(effect.parameters, cause.theta, cause.half_width, scale[columns], cause.at_bound, strict=True)
        parameters = {
            p.name: {"value": x * s, "ci95": [(x - w) * s, (x + w) * s], "unit": p.unit, "at_bound": bool(end)}
            for p, x, w, s, end in rows
        }
        rivals = {problem.effects[i].name: p for i, p in cause.rivals.items()}
        alike = sorted({*rivals, *(problem.effects[i].name for i in cause.confusable)})
        selection.append(
            NamedEffect(
                effect.name,
                cause.probability,
                cause.p_value,
                parameters,
                cause.invariance,
                alike,
                rivals,
                FAMILY_OF[effect.name],
                cause.family_probability,
                cause.error_share.share,
                list(cause.error_share.ci95),
                cause.exploratory,
                cause.curve.content() if cause.curve else None,
            )  # fmt: skip
        )
    return tuple(selection)


def find_causes(problem: Problem, selection: Selection) -> list[Cause]:
    """Return every named effect with its interval, probability and rivals, largest share first.

    One that ends at its bound, or whose size differs from run to run, stands for something else and is exploratory; so
    is one that explains little where a rival might as well, and one that errors of an inferred force may stand for.
    """
    columns = problem.columns(selection.selected)
    if not len(columns):
        return []
    constant, widths = invariance(problem, selection), half_widths(problem, selection.scores, selection.selected)
    model = quadratic_cost(problem, selection.fit, selection.linearisation)
    shares = shapley_shares(problem, selection)
    significances = selection.significance or significance(
        problem, selection, model, {i: one.share for i, one in shares.items()}
    )
    each = []
    ends = at_bound(problem, selection.fit.theta)
    for member in sorted(selection.selected, key=lambda i: -shares[i].share):
        own = problem.columns((member,))
        at = np.searchsorted(columns, own)
        share = effect_probabilities(problem, selection, model, member)
        rivals = {int(i): float(share[i]) for i in np.argsort(-share) if i != member and share[i] > RIVAL_PROBABILITY}
        alike, theta = confusable_effects(problem, selection, member), selection.fit.theta[own]
        cause = Cause(
            member,
            theta,
            widths[at],
            float(share[member]),
            rivals,
            alike,
            constant[member],
            significances[member].p_value,
            family_probability(problem, share, member),
            shares[member],
            ends[own],
            significances[member].exploratory,
            axle_curve(problem, selection, member),
        )  # fmt: skip
        each.append(_with_doubts(problem, cause))
    return each


def _with_doubts(problem: Problem, cause: Cause) -> Cause:
    """Return the cause, exploratory where its size or a rival gives reason to doubt it."""
    doubtful = cause.stands_in or cause.small_and_unsure or _of_inferred_force(problem, cause)
    return cause._replace(exploratory=cause.exploratory or doubtful)


def _of_inferred_force(problem: Problem, cause: Cause) -> bool:
    """Return whether errors of a force that was inferred beside the sideslip may be what was named.

    They are the same in all runs: where nothing is wrong with a car, scores are up to seven standard deviations off.
    """
    return problem.data.force_inferred and bool(np.all(np.abs(cause.theta) < FIRM * cause.half_width))


def with_sizes(problem: Problem, causes: list[Cause], sizes: PredictionFit) -> list[Cause]:
    """Return the causes, those of the car with the sizes, intervals and bounds of a fit to predictions."""
    ends, each = at_bound(problem, sizes.theta), []
    widths = dict(zip(sizes.columns, sizes.spread.half_width, strict=True))
    for cause in causes:
        own = problem.columns((cause.effect,))
        if own[0] in widths:
            width = np.array([widths[k] for k in own])
            cause = cause._replace(theta=sizes.theta[own], half_width=width, at_bound=ends[own])
        each.append(_with_doubts(problem, cause))
    return each


def spread_with(problem: Problem, selection: Selection, sizes: PredictionFit | None) -> ParameterSpread:
    """Return the uncertainty of the parameters of the named effects, of those of `sizes` as fitted to predictions.

    The latter are taken for independent of the others, which follow from other data.
    """
    columns = problem.columns(selection.selected)
    half_width, covariance = spread_of(selection.scores.H, selection.scores.blocks, columns)
    if sizes:
        own = np.searchsorted(columns, sizes.columns)
        half_width[own], covariance[own], covariance[:, own] = sizes.spread.half_width, 0.0, 0.0
        covariance[np.ix_(own, own)] = sizes.spread.covariance
    return ParameterSpread(half_width, covariance)


def half_widths(problem: Problem, last: Scores, selected: tuple[int, ...]) -> np.ndarray:
    """Return the half-widths (k,) of the 95 % intervals of the parameters of `selected`, in typical sizes."""
    return half_widths_from(last.H, last.blocks, problem.columns(selected))


def invariance(problem: Problem, selection: Selection) -> dict[int, float]:
    """Return per effect the smallest p-value of the hypothesis that its parameters are nearly the same in all runs.

    A cause has the same size in every run (Peters, Buhlmann and Meinshausen 2016), up to `TOLERANCE` of it: no model
    is exact, and much data would show any difference. The score of each run over its information, other members
    projected out, is an estimate; the spread of these is Cochran's Q (1954), with a variance from blocks of time.
    Parameters without information, as the delay of a channel that the log lacks, have no size that could differ.
    """
    columns, runs = problem.columns(selection.selected), np.unique(problem.data.run)
    if len(runs) < 2:
        return dict.fromkeys(selection.selected, 1.0)
    e, J = np.asarray(selection.linearisation.e), np.asarray(selection.linearisation.J)[..., columns]
    H = np.array([information(J[problem.data.run == run]) for run in runs])
    U = np.array([np.einsum("ptij,pti->j", J[problem.data.run == run], e[problem.data.run == run]) for run in runs])
    total, blocks = H.sum(axis=0), selection.scores.blocks[:, columns]
    size = (selection.fit.theta - problem.start)[columns]
    least = dict.fromkeys(selection.selected, 1.0)
    informed = np.diag(total) > NONE
    for k in np.flatnonzero(informed):
        other = informed & (np.arange(len(columns)) != k)
        w = np.zeros(len(columns))
        w[k], w[other] = 1.0, -np.linalg.solve(total[np.ix_(other, other)], total[other, k])
        known, score = np.einsum("j,rjk,k->r", w, H, w), U @ w
        excess = max(np.sum((blocks @ w) ** 2) / known.sum(), 1.0)
        member = int(problem.owner[columns[k]])
        least[member] = min(least[member], homogeneity_p_value(score, known, TOLERANCE * size[k], excess))
    return least


def homogeneity_p_value(score: np.ndarray, known: np.ndarray, tolerance: float, excess: float = 1.0) -> float:
    """Return the p-value of one size in all runs, from the scores (R,) and the information (R,) in each.

    Sizes may differ by a standard deviation `tolerance`; scores vary by `excess` times the information.
    """
    which = known > MIN_SHARE * known.sum()
    estimate = score[which] / known[which]
    weight = 1 / (excess / known[which] + tolerance**2)
    Q = float(weight @ (estimate - weight @ estimate / weight.sum()) ** 2)
    return float(chdtrc(max(which.sum() - 1, 1), Q))


def family_probability(problem: Problem, share: np.ndarray, member: int) -> float:
    """Return the probability that an effect of the family of `member` acts: the sum of those (E,) of its effects."""
    family = [FAMILY_OF[effect.name] for effect in problem.effects]
    return float(sum(p for name, p in zip(family, share, strict=True) if name == family[member]))


def own_scores(problem: Problem, selection: Selection, model: QuadraticCost, member: int) -> Scores:
    """Return the scores of all effects when `member` is removed and the others are refitted, to first order.

    Their p-values are adjusted for all effects, but not for the search itself.
    """
    rest = tuple(i for i in selection.selected if i != member)
    psi, linearisation = best_parameters(model, rest), selection.linearisation
    back = psi - (selection.fit.theta - problem.start)
    e = np.asarray(linearisation.e) - np.asarray(linearisation.J) @ back
    return scores(problem, linearisation._replace(e=e), problem.start + psi, rest, 0)


def significance(
    problem: Problem, selection: Selection, model: QuadraticCost, shares: dict[int, float]
) -> dict[int, Significance]:
    """Test each named effect for significance, in order of its Shapley share.

    Those of the largest share, as many as the test alone may name, are significant where their own p-value is below
    5 %; others are exploratory, under a false discovery rate of 10 % among all effects. Both tests take the blocks as
    many and alike. Where a few hard manoeuvres say most, they see nothing of an effect that may explain most of the
    error; there its own blocks are enough if they agree by more than chance would in one log of a thousand (`STRONG`).
    """
    alone = {i: own_scores(problem, selection, model, i) for i in selection.selected}
    own = {i: alone[i].p_value_of(i, problem.columns((i,))) for i in alone}
    active = [i for i in range(len(problem.effects)) if problem.active[problem.columns((i,))].all()]
    single = np.array([alone.get(i, selection.scores).single_p_value(i, problem.columns((i,))) for i in active])
    passed = dict(zip(active, benjamini_yekutieli(single, DISCOVERY_RATE), strict=True))
    first = sorted(alone, key=lambda i: -shares[i])[: selection.free]
    by_chance = {i: min(len(active) * alone[i].own_p_value(i, problem.columns((i,))), own[i]) for i in alone}
    strong = {i: by_chance[i] < STRONG for i in alone}
    passes = {i: i in first and (own[i] < LEVEL or strong[i]) for i in alone}
    supported = {i: passes[i] or strong[i] or bool(passed.get(i, True)) for i in alone}
    return {i: Significance(own[i], not passes[i], supported[i], by_chance[i]) for i in alone}


def confusable_effects(problem: Problem, selection: Selection, member: int) -> tuple[int, ...]:
    """Return the effects that nearly reproduce the signature of `member` in these data, other selected ones removed.

    Measured by the canonical correlation, in the metric of the information, of the fitted signature of `member` with
    those of all parameters of the other effect (Hotelling 1936); of two single parameters that is their cosine.
    """
    H = selection.scores.H
    P = partial_out(H, problem.columns(tuple(i for i in selection.selected if i != member)))
    own, apart = problem.columns((member,)), P.T @ H @ P
    free = np.diag(apart) > CONDITION * np.diag(H)  # others are but rounding
    moved = (selection.fit.theta - problem.start)[own]
    power = moved @ apart[np.ix_(own, own)] @ moved
    alike = []
    for i in range(len(problem.effects)):
        columns = problem.columns((i,))
        columns = columns[free[columns]]
        if i in selection.selected or not len(columns) or power <= 0:
            continue
        b = apart[np.ix_(columns, own)] @ moved
        if (
            b @ np.linalg.pinv(apart[np.ix_(columns, columns)], CONDITION, hermitian=True) @ b
            > CONFUSABLE_COSINE**2 * power
        ):
            alike.append(i)
    return tuple(alike)
