"""Contrast two logs of one car: differences of all parameters, with the shared parameters profiled out.

Each log is linearised about a fit of its own. With parameters c in the first log and c + d in the second one, the cost
of d minimised over c (Neyman 1959, C(alpha)) is again quadratic, and its score again a sum over blocks of time, so that
tests, beam search and intervals of a diagnosis work on differences unchanged. An error that both logs have changes c,
not d; a direction that only one of the logs excites has no information on d.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from driftjax.diagnosis.beam import QuadraticCost, beam_search, best_parameters, gain_of, parameters_of
from driftjax.diagnosis.evidence import RIVAL_PROBABILITY
from driftjax.diagnosis.fit import Fit, Problem, evaluate_fit, information, linearise
from driftjax.diagnosis.noise import PRIOR
from driftjax.diagnosis.quadratic import minimise_quadratic
from driftjax.diagnosis.refine import STEP_LENGTHS, refit_to_convergence
from driftjax.diagnosis.rivals import REFITTED, hypothesis_probabilities, replaced, rival_gains
from driftjax.diagnosis.runs import Linearisation
from driftjax.diagnosis.score import (
    CONDITION,
    NONE,
    Scores,
    covariance,
    half_widths_from,
    joint_score,
    null_max_scores,
    partial_out,
    studentised_scores,
    sum_by_block,
)
from driftjax.diagnosis.select import LEVEL, MARGIN, MIN_SIZE, PARAMETER_PENALTY, STRIDE

MIN_RUNS = 4  # runs of each log from which the spread between runs counts in an interval
STEPS = 8  # Gauss-Newton steps of both logs together, at most
SETTLED = 0.01  # largest change of a parameter, in typical sizes, from which these steps have converged


class Information(NamedTuple):
    """Information of one log on all parameters, linearised at one fit."""

    theta: np.ndarray  # (K,) of the fit
    H: np.ndarray  # (C, K, K) information by block of time
    score: np.ndarray  # (C, K)
    run: np.ndarray  # (C,) number of the run of each block

    def total(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the information H (K, K) of the log, and H theta + score (K,), the right-hand side of its minimum."""
        H = self.H.sum(axis=0)
        return H, self.score.sum(axis=0) + H @ self.theta

    def at(self, theta: np.ndarray) -> np.ndarray:
        """Return the scores (C, K) at other parameters `theta` (K,)."""
        return self.score - self.H @ (theta - self.theta)


def information_of(problem: Problem, fit: Fit, linearisation: Linearisation) -> Information:
    """Return the information of the log of `problem`, with its `linearisation` at `fit`."""
    J, e, block = np.asarray(linearisation.J), np.asarray(linearisation.e), problem.data.block
    num = problem.data.num_blocks
    H = np.stack([information(J[block == k][None]) for k in range(num)])
    run = np.zeros(num, int)
    run[block] = problem.data.run[:, None]
    return Information(fit.theta, H, sum_by_block(problem, np.einsum("ptik,pti->ptk", J, e)), run)


class Contrast(NamedTuple):
    """Two logs, each about its fit, and the cost of their differences d (K,), in typical sizes."""

    first: Information
    second: Information
    start: np.ndarray  # (K,) theta of the nominal car
    share: np.ndarray  # (K, K) M H_B: how scores of c count in those of d
    cost: QuadraticCost  # of d, everything else at its best

    def shared(self, d: np.ndarray) -> np.ndarray:
        """Return the parameters c (K,) that fit both logs best for the differences `d` (K,)."""
        (HA, bA), (HB, bB) = self.first.total(), self.second.total()
        M = HA + HB + np.eye(len(d)) / PRIOR**2
        return np.linalg.solve(M, bA + bB - HB @ d + self.start / PRIOR**2)


def contrast_of(problem: Problem, first: Information, second: Information) -> Contrast:
    """Return the contrast of two logs of `problem`'s car."""
    (HA, bA), (HB, bB) = first.total(), second.total()
    prior = np.eye(len(HA)) / PRIOR**2
    share = np.linalg.solve(HA + HB + prior, HB)
    c = np.linalg.solve(HA + HB + prior, bA + bB + problem.start / PRIOR**2)
    span = problem.upper - problem.lower
    columns = tuple(problem.columns((i,)) for i in range(len(problem.effects)))
    active = tuple(k if problem.active[k].all() else k[:0] for k in columns)
    H = HB - HB @ share
    cost = QuadraticCost(0.0, bB - HB @ c, 0.5 * (H + H.T) + prior, -span, span, active)
    return Contrast(first, second, problem.start, share, cost)


def difference_scores(contrast: Contrast, d: np.ndarray, selected: tuple[int, ...], seed: int) -> Scores:
    """Test the differences of all effects outside `selected` at `d` (K,), minimised over the shared parameters.

    H and scores of the result are those of d; blocks of the first log come first.
    """
    c, model = contrast.shared(d), contrast.cost
    a, b = contrast.first.at(c), contrast.second.at(c + d)
    blocks = np.concatenate([-a @ contrast.share, b - b @ contrast.share])
    H = model.H - np.eye(len(d)) / PRIOR**2
    columns = parameters_of(model, selected)
    P = partial_out(H, columns)
    effective, left = blocks @ P, P.T @ H @ P
    own = np.diag(left) > CONDITION * np.maximum(np.diag(H), 1.0)
    own[columns] = False
    own &= np.isin(np.arange(len(d)), np.concatenate(model.columns))
    T, U = studentised_scores(effective, own), effective.sum(axis=0)
    several = {i: k for i, k in enumerate(model.columns) if len(k) > 1 and own[k].all()}
    joint = np.zeros(len(model.columns))
    for i, k in several.items():
        joint[i] = joint_score(effective[:, k], U[None, k])[0]
    chance = null_max_scores(effective, own, np.zeros(len(d), bool), seed, list(several.values()))
    return Scores(H, blocks, T, joint, np.zeros(len(joint)), chance, effective[:, own], seed)


def with_dispersion(contrast: Contrast) -> Contrast:
    """Return the contrast whose costs count in units of their dispersion, as in QAIC (Burnham and Anderson 2002)."""
    model, excess = contrast.cost, dispersion(contrast)
    return contrast._replace(cost=model._replace(g=model.g / excess, H=model.H / excess))


def dispersion(contrast: Contrast) -> float:
    """Return the dispersion of all scores where every difference is at its best; 1 where it would be less."""
    every = tuple(range(len(contrast.cost.columns)))
    best = difference_scores(contrast, best_parameters(contrast.cost, every), (), 0)
    own = np.diag(best.H) > 1.0
    return max(float(np.mean((best.blocks**2).sum(axis=0)[own] / np.diag(best.H)[own])), 1.0) if own.any() else 1.0


def search_differences(contrast: Contrast, seed: int, most: int) -> tuple[int, ...]:
    """Return the effects, at most `most`, whose sizes differ: the set of least penalised cost whose members pass.

    Each of them is material (`is_material`) and significant given the others, at a family-wise rate of 5 %.
    """
    model, selected = with_dispersion(contrast).cost, ()
    gain = lambda effects: gain_of(model, best_parameters(model, effects))
    penalised = lambda effects: PARAMETER_PENALTY * len(parameters_of(model, effects)) - gain(effects)
    while True:
        sets = beam_search(model, min(len(selected) + STRIDE, most), PARAMETER_PENALTY)
        best = next((one.effects for one in sets if all_material(model, one.psi, one.effects)), ())
        new = eliminate_insignificant(contrast, best, seed)
        if penalised(new) >= penalised(selected) - MARGIN:
            return selected
        selected = new


def all_material(model: QuadraticCost, psi: np.ndarray, effects: tuple[int, ...]) -> bool:
    """Return whether every one of `effects` differs materially at `psi` (K,)."""
    return all(np.abs(psi[model.columns[i]]).max() >= MIN_SIZE for i in effects)


def eliminate_insignificant(contrast: Contrast, selected: tuple[int, ...], seed: int) -> tuple[int, ...]:
    """Eliminate differences one by one, the least significant first, until all of `selected` are significant.

    Each must also exceed the variation of sizes from run to run, at a family-wise rate of 5 % too.
    """
    num = sum(len(k) > 0 for k in contrast.cost.columns)
    while selected:
        p_values = {i: p_value_of(contrast, selected, i, seed) for i in selected}
        psi, width = intervals(contrast, selected, LEVEL / num)
        owner = np.repeat(selected, [len(contrast.cost.columns[i]) for i in selected])
        certain = {i: bool((np.abs(psi) > width)[owner == i].any()) for i in selected}
        worst = max(selected, key=lambda i: (not certain[i], p_values[i]))
        if certain[worst] and p_values[worst] < LEVEL:
            return selected
        selected = tuple(i for i in selected if i != worst)
    return ()


def p_value_of(contrast: Contrast, selected: tuple[int, ...], member: int, seed: int) -> float:
    """Return the p-value of the difference of `member` given the others, adjusted for all effects.

    Compares the difference over its robust standard error with the largest score under random signs, both at the
    fitted differences: the residuals that a large difference left out would cause would inflate the variance.
    """
    psi, own = best_parameters(contrast.cost, selected), contrast.cost.columns[member]
    rest = tuple(i for i in selected if i != member)
    result = difference_scores(contrast, psi, rest, seed)
    P = partial_out(result.H, parameters_of(contrast.cost, rest))
    own = own[np.diag(P.T @ result.H @ P)[own] > NONE]
    if not len(own):
        return 1.0
    effective, known = result.blocks @ P[:, own], P[:, own].T @ result.H @ P[:, own]
    U = known @ psi[own]
    size = float(np.abs(U / np.sqrt(np.maximum((effective**2).sum(axis=0), np.diag(known)))).max())
    if len(own) > 1:
        size = max(size, float(joint_score(effective, U[None])[0]))
    return float((1 + np.sum(result.null_max >= size)) / (len(result.null_max) + 1))


def intervals(contrast: Contrast, selected: tuple[int, ...], run_level: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Return the differences (k,) of the parameters of `selected`, and half-widths (k,) of their 95 % intervals.

    Robust to dependence within blocks of time and, where both logs have several runs, to sizes that vary from run to
    run (at `run_level`): the wider one counts.
    """
    psi, columns = best_parameters(contrast.cost, selected), parameters_of(contrast.cost, selected)
    result = difference_scores(contrast, psi, selected, 0)
    width = half_widths_from(result.H, result.blocks, columns)
    runs = [np.unique(one.run, return_inverse=True)[1] for one in (contrast.first, contrast.second)]
    num = [run.max() + 1 for run in runs]
    if min(num) >= MIN_RUNS:
        sums = np.zeros((sum(num), result.blocks.shape[1]))
        np.add.at(sums, np.concatenate([runs[0], runs[1] + num[0]]), result.blocks)
        spread = np.sqrt(np.diag(covariance(result.H, sums, columns)))
        width = np.maximum(width, stdtrit(max(sum(num) - len(columns) - 1, 1), 1 - run_level / 2) * spread)
    return psi[columns], width


def probabilities(
    contrast: Contrast, selected: tuple[int, ...], member: int, refitted: dict[tuple[int, ...], float] | None = None
) -> np.ndarray:
    """Return the probabilities (E,) that `member`, or another effect in its place, differs.

    `refitted` has the penalised costs of sets of differences in units of their dispersion, where they are known beyond
    the linear models.
    """
    model, known = with_dispersion(contrast).cost, refitted or {}
    costs = -rival_gains(model, tuple(i for i in selected if i != member))
    costs[member] = -gain_of(model, best_parameters(model, selected))
    sizes = np.array([max(len(k), 1) for k in model.columns])
    for rival in range(len(costs)):
        instead = replaced(selected, member, rival)
        if rival != member and instead in known:
            rise = known[instead] - known[selected] - PARAMETER_PENALTY * (sizes[rival] - sizes[member])
            costs[rival] = costs[member] + rise
    return hypothesis_probabilities(costs, sizes, 1.0)


class Pair(NamedTuple):
    """Two logs of one car with the effects fitted to both, and their contrast."""

    problems: tuple[Problem, Problem]
    effects: tuple[int, ...]  # fitted to each log
    fits: tuple[Fit, Fit]
    linearisations: tuple[Linearisation, Linearisation]
    contrast: Contrast
    refitted: dict[tuple[int, ...], float] | None = None  # see `probabilities`


def fit_pair(problems: tuple[Problem, Problem], effects: tuple[int, ...], starts: tuple[np.ndarray, ...]) -> Pair:
    """Fit `effects` to each log by itself, from the parameters `starts`."""
    columns = problems[0].columns(effects)
    each = [
        refit_to_convergence(problem, evaluate_fit(problem, theta), columns)
        for problem, theta in zip(problems, starts, strict=True)
    ]
    (fit_a, at_a), (fit_b, at_b) = each
    known = [information_of(problem, *one) for problem, one in zip(problems, each, strict=True)]
    return Pair(problems, effects, (fit_a, fit_b), (at_a, at_b), contrast_of(problems[0], *known))


class Sizes(NamedTuple):
    """Parameters of the differing effects in both logs, in typical sizes, (k,) each."""

    first: np.ndarray
    second: np.ndarray
    first_error: np.ndarray  # standard error
    second_error: np.ndarray
    difference: np.ndarray
    half_width: np.ndarray  # of its 95 % interval


def fit_together(pair: Pair, selected: tuple[int, ...]) -> tuple[Contrast, Sizes]:
    """Fit both logs together: sizes of `pair.effects` shared, those of `selected` separate.

    Returns the contrast about that fit. Differences and their intervals are those with all shared parameters profiled
    out, sizes in each log those with the parameters of `pair.effects` only.
    """
    contrast, fits = refit_together(pair, selected)
    columns, own = pair.problems[0].columns(pair.effects), pair.problems[0].columns(selected)
    c, d = fits[0].theta, fits[1].theta - fits[0].theta
    difference, width = intervals(contrast, selected)
    error_a, error_b = _standard_errors(contrast, columns, own, c, d)
    return contrast, Sizes(c[own], c[own] + difference, error_a, error_b, difference, width)


def refit_together(pair: Pair, selected: tuple[int, ...]) -> tuple[Contrast, tuple[Fit, Fit]]:
    """Refine both fits together by Gauss-Newton steps within bounds, each shortened until the sum of costs falls.

    Sizes of `pair.effects` are shared, those of `selected` separate. Returns the contrast about the fits, too.
    """
    problems, contrast = pair.problems, pair.contrast
    own, columns = problems[0].columns(selected), problems[0].columns(pair.effects)
    shared, start = np.setdiff1d(columns, own), problems[0].start

    def evaluate(thetas: Sequence[np.ndarray] | np.ndarray) -> tuple[Fit, Fit]:
        return evaluate_fit(problems[0], thetas[0]), evaluate_fit(problems[1], thetas[1])

    alike = [np.where(np.isin(np.arange(len(start)), columns), fit.theta, start) for fit in pair.fits]
    starts = _joint_minimum(problems, contrast, shared, own), *((theta, theta) for theta in alike)
    fits = min((evaluate(one) for one in starts), key=sum_of_costs)
    for k in range(STEPS + 1):
        known = [information_of(p, fit, linearise(p, fit)) for p, fit in zip(problems, fits, strict=True)]
        contrast, before = contrast_of(problems[0], *known), np.stack([fit.theta for fit in fits])
        step = _joint_minimum(problems, contrast, shared, own) - before
        if k == STEPS or np.abs(step).max() < SETTLED:
            break
        trials = (evaluate(before + length * step) for length in (1.0, *STEP_LENGTHS))
        better = next((one for one in trials if sum_of_costs(one) < sum_of_costs(fits)), None)
        if better is None:
            break
        fits = better
    return contrast, fits


def prefer_refitted(pair: Pair, selected: tuple[int, ...]) -> tuple[Pair, tuple[int, ...]]:
    """Replace differences by rivals that cost less where both logs are fitted together; return these costs in the pair.

    The linear models are about the fit of each log by itself, and these may be far apart.
    """
    excess, known = dispersion(pair.contrast), dict[tuple[int, ...], float]()
    wider = lambda effects: pair._replace(effects=tuple(sorted({*pair.effects, *effects})), refitted=known)

    def penalised(effects: tuple[int, ...]) -> float:
        if effects not in known:
            fitted = wider(effects)
            num = sum(len(pair.problems[0].columns(which)) for which in (fitted.effects, effects))
            known[effects] = sum_of_costs(refit_together(fitted, effects)[1]) / excess + PARAMETER_PENALTY * num
        return known[effects]

    while selected:
        rivals = [replaced(selected, i, j) for i in selected for j in _credible(pair.contrast, selected, i)]
        best = min([selected, *rivals], key=penalised)
        if best == selected:
            break
        selected = best
    return wider(selected), selected


def _credible(contrast: Contrast, selected: tuple[int, ...], member: int) -> list[int]:
    """Return the rivals of `member` with a probability, the most probable first, at most `REFITTED`."""
    share = probabilities(contrast, selected, member)
    rivals = [int(j) for j in np.argsort(-share) if j not in selected and share[j] > RIVAL_PROBABILITY]
    return rivals[:REFITTED]


def sum_of_costs(fits: tuple[Fit, Fit]) -> float:
    """Return the cost of both logs."""
    return fits[0].cost + fits[1].cost


def _joint_minimum(
    problems: tuple[Problem, Problem], contrast: Contrast, shared: np.ndarray, own: np.ndarray
) -> np.ndarray:
    """Return the parameters (2, K) of both logs within their bounds that minimise the sum of the quadratic costs.

    Those `shared` are the same in both logs, those of their `own` are not, and all others stay where they start.
    """
    problem, n, k = problems[0], len(shared), len(own)
    H, right = np.zeros((n + 2 * k, n + 2 * k)), np.zeros(n + 2 * k)
    each = [np.concatenate([np.arange(n), np.arange(k) + n + which * k]) for which in (0, 1)]
    free = np.concatenate([shared, own])
    for one, at in zip((contrast.first, contrast.second), each, strict=True):
        information, b = one.total()
        H[np.ix_(at, at)] += information[np.ix_(free, free)] + problem.prior[np.ix_(free, free)]
        right[at] += b[free] - information[free] @ problem.start
    every = np.concatenate([shared, own, own])
    lower, upper = ((side - problem.start)[every] for side in (problem.lower, problem.upper))
    moved, thetas = minimise_quadratic(right, H, lower, upper), np.stack([problem.start, problem.start])
    for theta, at in zip(thetas, each, strict=True):
        theta[free] += moved[at]
    return thetas


def _both(contrast: Contrast) -> np.ndarray:
    """Return the information (2K, 2K) of c and d together."""
    HA, HB = contrast.first.total()[0], contrast.second.total()[0]
    return np.block([[HA + HB, HB], [HB, HB]])


def _standard_errors(
    contrast: Contrast, columns: np.ndarray, own: np.ndarray, c: np.ndarray, d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard errors of the parameters `own` in the first and in the second log."""
    K, H = len(c), _both(contrast)
    a, b = contrast.first.at(c), contrast.second.at(c + d)
    blocks = np.concatenate([np.concatenate([a, 0 * a], axis=1), np.concatenate([b, b], axis=1)])
    free = np.concatenate([columns, K + own])
    full = np.zeros_like(H)
    full[np.ix_(free, free)] = covariance(H, blocks, free)
    of = lambda rows, others: np.diag(full[np.ix_(rows, others)])
    second = of(own, own) + of(K + own, K + own) + 2 * of(own, K + own)
    return np.sqrt(np.maximum(of(own, own), 0.0)), np.sqrt(np.maximum(second, 0.0))
