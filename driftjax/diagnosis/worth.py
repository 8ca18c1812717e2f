"""What each named effect is worth: its share of what all of them explain together.

Effects that explain the same error share it as Shapley (1953) divides a gain: each gets the mean, over all orders of
adding them, of what it adds. What a set explains follows from the quadratic model of the cost about the fit.
"""

from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.beam import QuadraticCost, parameters_of
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.score import sums_by_block
from driftjax.diagnosis.select import Selection

RESAMPLES = 500  # of the blocks of time


class Worth(NamedTuple):
    """Share of one effect in what all named effects explain of the cost; shares add to 1."""

    share: float
    ci95: tuple[float, float]  # over blocks of time


def shapley_shares(problem: Problem, selection: Selection, model: QuadraticCost, seed: int = 0) -> dict[int, Worth]:
    """Return the share of every named effect in the fall of the cost, which `model` describes about the fit."""
    members = selection.selected
    if not members:
        return {}
    at, moved = selection.linearisation, selection.fit.theta - problem.start
    J = np.asarray(at.J)
    blocks = sums_by_block(problem, np.asarray(at.e) + J @ moved, J)[1]  # (C, K) of the nominal car, to first order
    weights = np.random.default_rng(seed).multinomial(len(blocks), np.full(len(blocks), 1 / len(blocks)), RESAMPLES)
    g = np.concatenate([model.g[None], weights @ blocks])  # (1 + RESAMPLES, K), the data themselves first
    value: dict[tuple[int, ...], np.ndarray] = {(): np.zeros(len(g))}
    for size in range(1, len(members) + 1):
        for chosen in combinations(members, size):
            c = parameters_of(model, chosen)
            value[chosen] = np.einsum("rk,kr->r", g[:, c], np.linalg.solve(model.H[np.ix_(c, c)], g[:, c].T))
    found = {}
    for i in members:
        others = tuple(j for j in members if j != i)
        gained = np.zeros(len(g))
        for size in range(len(others) + 1):
            weight = 1 / (len(members) * comb(len(others), size))
            for chosen in combinations(others, size):
                grown = tuple(j for j in members if j == i or j in chosen)
                gained += weight * (value[grown] - value[chosen])
        share = gained / value[members]
        found[i] = Worth(float(share[0]), tuple(np.percentile(share[1:], [2.5, 97.5]).tolist()))
    return found
