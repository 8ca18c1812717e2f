"""Beam search for sets of effects, on the quadratic model of the cost about one fit.

One linearisation gives the information of all parameters. The cost of any set of effects then follows by linear
algebra, which finds pairs whose single gains cancel, and one effect that replaces two, without refitting.
"""

from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.fit import Fit, Problem, information_and_score
from driftjax.diagnosis.quadratic import minimise_quadratic
from driftjax.diagnosis.runs import Linearisation

WIDTH = 50  # sets kept of each size
INDEPENDENT = 1e-8  # share of a parameter's information that must be its own beside the set


class QuadraticCost(NamedTuple):
    """Cost of the parameters `psi`, measured from the nominal car: cost - 2 g psi + psi H psi."""

    cost: float  # of the nominal car, by this model
    g: np.ndarray  # (K,)
    H: np.ndarray  # (K, K) information, prior included
    lower: np.ndarray  # (K,) bounds of psi
    upper: np.ndarray
    columns: tuple[np.ndarray, ...]  # parameters of each effect; empty where it is not active


class EffectSet(NamedTuple):
    """A set of effects and the minimum of the quadratic model over its parameters."""

    effects: tuple[int, ...]  # ascending
    psi: np.ndarray  # (K,) minimiser within the bounds, zero outside the set
    gain: float  # fall of the cost below the nominal car's


def quadratic_cost(problem: Problem, fit: Fit, linearisation: Linearisation) -> QuadraticCost:
    """Return the quadratic model of the cost about `fit`, which the `linearisation` belongs to."""
    return quadratic_about(problem, fit, *information_and_score(linearisation))


def quadratic_about(problem: Problem, fit: Fit, H: np.ndarray, score: np.ndarray) -> QuadraticCost:
    """Return the quadratic model of the cost about `fit` from information (K, K) and score (K,) of data alone."""
    moved = fit.theta - problem.start
    H, score = H + problem.prior, score - problem.prior @ moved
    cost = fit.cost + float(2 * score @ moved + moved @ H @ moved)
    columns = tuple(problem.columns((i,)) for i in range(len(problem.effects)))
    active = tuple(c if problem.active[c].all() else c[:0] for c in columns)
    return QuadraticCost(
        cost, score + H @ moved, H, problem.lower - problem.start, problem.upper - problem.start, active
    )


def best_parameters(model: QuadraticCost, effects: tuple[int, ...]) -> np.ndarray:
    """Return the minimiser (K,) over the parameters of `effects` within their bounds, zero elsewhere."""
    columns, psi = parameters_of(model, effects), np.zeros(len(model.g))
    H = model.H[np.ix_(columns, columns)]
    psi[columns] = minimise_quadratic(model.g[columns], H, model.lower[columns], model.upper[columns])
    return psi


def gain_of(model: QuadraticCost, psi: np.ndarray) -> float:
    """Return the fall of the cost from the nominal car's to that at `psi` (K,)."""
    return float(2 * model.g @ psi - psi @ model.H @ psi)


def minimise_over(model: QuadraticCost, effects: tuple[int, ...]) -> EffectSet | None:
    """Return the set of `effects` at its minimum; None where one of them is not needed there."""
    psi = best_parameters(model, effects)
    needed = all(psi[model.columns[i]].any() for i in effects)
    return EffectSet(effects, psi, gain_of(model, psi)) if needed else None


def ends_at_bound(model: QuadraticCost, psi: np.ndarray) -> np.ndarray:
    """Return which parameters (K,) of `psi` (K,) lie on a bound that is not the nominal car's own value."""
    return (psi != 0) & ((psi == model.lower) | (psi == model.upper))


def parameters_of(model: QuadraticCost, effects: tuple[int, ...]) -> np.ndarray:
    """Return the parameter indices of `effects`."""
    return np.concatenate([model.columns[i] for i in effects]) if effects else np.zeros(0, int)


def gains_of_adding(model: QuadraticCost, effects: tuple[int, ...]) -> np.ndarray:
    """Return the further cost decrease (E,) by adding each effect to `effects`, without bounds; -inf for members."""
    columns, g, H = parameters_of(model, effects), model.g, model.H
    if len(columns):
        taken = np.linalg.solve(H[np.ix_(columns, columns)], np.column_stack([H[columns], g[columns]]))
        g, H = g - H[:, columns] @ taken[:, -1], H - H[:, columns] @ taken[:, :-1]
    own = np.diag(H) > INDEPENDENT * np.diag(model.H)
    gains = np.full(len(model.columns), -np.inf)
    for i, c in enumerate(model.columns):
        if i not in effects and len(c) and own[c].all():
            gains[i] = g[c[0]] ** 2 / H[c[0], c[0]] if len(c) == 1 else g[c] @ np.linalg.solve(H[np.ix_(c, c)], g[c])
    return gains


def beam_search(model: QuadraticCost, most: int, penalty: float) -> list[EffectSet]:
    """Return sets of up to `most` effects, lowest cost plus `penalty` per parameter first; at most `WIDTH` a size.

    Each set of one size is extended by every effect; all pairs are looked at, since singles are all kept.
    """
    penalty_of = lambda effects: penalty * len(parameters_of(model, effects))
    penalised = lambda one: one.gain - penalty_of(one.effects)
    sets: list[EffectSet] = []
    beam = [EffectSet((), np.zeros(len(model.g)), 0.0)]
    for size in range(1, most + 1):
        promised: dict[tuple[int, ...], float] = {}
        for one in beam:
            for i, gain in enumerate(gains_of_adding(model, one.effects)):
                if np.isfinite(gain):
                    grown = tuple(sorted((*one.effects, i)))
                    promised[grown] = one.gain + gain - penalty_of(grown)
        keep = len(promised) if size == 1 else WIDTH
        beam = []
        for grown in sorted(promised, key=lambda name: -promised[name]):
            if len(beam) >= keep:
                break
            if (one := minimise_over(model, grown)) is not None:
                beam.append(one)
        sets += sorted(beam, key=lambda one: -penalised(one))[:WIDTH]
    return sorted(sets, key=lambda one: -penalised(one))
