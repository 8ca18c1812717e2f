"""Divide the explained error among the named effects (Shapley shares).

Effects that explain the same error share it as Shapley (1953) divides a gain: each gets the mean, over all orders of
adding them, of what it adds. What a set explains follows from the derivatives at the fit. Only errors of V, beta and r
count, which a user wants predicted, and not how well pose and accelerations agree.
"""

from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.noise import PRIOR
from driftjax.diagnosis.score import sums_by_block
from driftjax.diagnosis.select import Selection
from driftjax.logs.columns import MEASURED

RESAMPLES = 500  # of the blocks of time


class ErrorShare(NamedTuple):
    """Share of one effect in the cost that all named effects explain; shares add to 1."""

    share: float
    ci95: tuple[float, float]  # over blocks of time


def shapley_shares(problem: Problem, selection: Selection) -> dict[int, ErrorShare]:
    """Return the share of every named effect in the fall of the cost of V, beta and r, to first order about the fit."""
    members = selection.selected
    if not members:
        return {}
    linearisation, moved = selection.linearisation, selection.fit.theta - problem.start
    e, J = (np.asarray(a)[:, :, : len(MEASURED)] for a in (linearisation.e, linearisation.J))
    H, blocks = sums_by_block(problem, e + J @ moved, J)  # scores (C, K) of the nominal car, to first order
    H += np.eye(len(H)) / PRIOR**2
    weights = np.random.default_rng(0).multinomial(len(blocks), np.full(len(blocks), 1 / len(blocks)), RESAMPLES)
    g = np.concatenate([blocks.sum(axis=0)[None], weights @ blocks])  # (1 + RESAMPLES, K), the data themselves first
    value: dict[tuple[int, ...], np.ndarray] = {(): np.zeros(len(g))}
    for size in range(1, len(members) + 1):
        for chosen in combinations(members, size):
            c = problem.columns(chosen)
            value[chosen] = np.einsum("rk,kr->r", g[:, c], np.linalg.solve(H[np.ix_(c, c)], g[:, c].T))
    shares = {}
    for i in members:
        others = tuple(j for j in members if j != i)
        gained = np.zeros(len(g))
        for size in range(len(others) + 1):
            weight = 1 / (len(members) * comb(len(others), size))
            for chosen in combinations(others, size):
                grown = tuple(j for j in members if j == i or j in chosen)
                gained += weight * (value[grown] - value[chosen])
        share = gained / value[members]
        shares[i] = ErrorShare(float(share[0]), tuple(np.percentile(share[1:], [2.5, 97.5]).tolist()))
    return shares
