"""Cross-validate sets of effects: how well each predicts parts of the log that it was fitted without.

A part is a run, or a piece of one with a buffer about it where there are few runs. Fits without it follow by linear
algebra from information and scores by block, so that a set costs one prediction of all runs (Racine 2000 for the
buffer). Errors are open-loop, 1 and 2 sqrt(L/g) ahead.
"""

from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.beam import best_parameters, quadratic_about
from driftjax.diagnosis.fit import Fit, Problem
from driftjax.diagnosis.gain import DECISIVE, Errors, at_horizons, horizon_steps, predict
from driftjax.diagnosis.runs import BLOCK, Linearisation, Pieces

MIN_RUNS = 4  # runs from which total runs are left out
MIN_SHARE = 0.4  # of the blocks of time that every fit must keep: either of two runs may be left out
MIN_FALL = 0.02  # of the error by which more effects must predict better
MAX_RISE = 0.05  # of the error of one channel that is tolerated
LOST = 0.1  # share of the predictions that late sensors may leave without a measurement
CLUSTERS = 4  # pieces from which they are the units of the standard error; blocks of time where there are fewer


class Change(NamedTuple):
    """Change of the logarithm of the open-loop error, with standard errors."""

    total: float  # of all channels and horizons
    total_error: float
    channel: np.ndarray  # (3,) of V, beta, r
    channel_error: np.ndarray  # (3,)

    @property
    def improves(self) -> bool:
        """Return whether the error falls by enough and by its standard error, and that of no channel rises.

        The error of a channel rises where it does by more than tolerated, and by its standard error.
        """
        rises = (self.channel > np.log1p(MAX_RISE)) & (self.channel > self.channel_error)
        return self.total < min(np.log1p(-MIN_FALL), -self.total_error) and not rises.any()


def left_out_blocks(data: Pieces, buffer: int) -> np.ndarray | None:
    """Return the blocks of time (P, C) left out of the fit that predicts each piece; None for a log that is too short.

    These are those of its run, or its own ones with `buffer` blocks before and after them.
    """
    P, C = len(data.run), data.num_blocks
    inside = np.zeros((P, C), bool)
    inside[np.arange(P)[:, None], data.block] = True
    of_run = np.array([inside[data.run == run].any(axis=0) for run in data.run])
    near = inside.copy()
    for k in range(1, buffer + 1):
        near[:, k:] |= inside[:, :-k]
        near[:, :-k] |= inside[:, k:]
    ways = [of_run] * (len(np.unique(data.run)) >= MIN_RUNS) + [near & of_run]
    return next((out for out in ways if out.mean(axis=1).max() <= 1 - MIN_SHARE), None)


def left_out(problem: Problem) -> np.ndarray | None:
    """Return the blocks of time (P, C) left out for each piece, with a buffer as long as predictions last, or None."""
    steps = horizon_steps(problem)
    return left_out_blocks(problem.data, int(np.ceil(steps[DECISIVE] * problem.data.dt / BLOCK)))


def fits_left_out(
    problem: Problem, fit: Fit, linearisation: Linearisation, selected: tuple[int, ...], out: np.ndarray
) -> np.ndarray:
    """Return the parameters (P, K) of `selected` fitted without the blocks `out` (P, C) of each piece, to first order.

    `linearisation` is that at `fit`.
    """
    columns, C, K = problem.columns(selected), problem.data.num_blocks, len(problem.start)
    theta = np.tile(problem.start, (len(out), 1))
    if not len(columns):
        return theta
    J, block = np.asarray(linearisation.J)[..., columns], problem.data.block
    by_block = np.zeros((C, len(columns), len(columns))), np.zeros((C, len(columns)))
    np.add.at(by_block[0], block, np.einsum("ptij,ptik->ptjk", J, J, optimize=True))
    np.add.at(by_block[1], block, np.einsum("ptij,pti->ptj", J, np.asarray(linearisation.e)))
    for way in np.unique(out, axis=0):
        H, score = np.zeros((K, K)), np.zeros(K)
        H[np.ix_(columns, columns)], score[columns] = (part[~way].sum(axis=0) for part in by_block)
        theta[(out == way).all(axis=1)] += best_parameters(quadratic_about(problem, fit, H, score), selected)
    return theta


def held_out_errors(
    problem: Problem, fit: Fit, linearisation: Linearisation, selected: tuple[int, ...]
) -> Errors | None:
    """Return the open-loop errors of the effects `selected` on parts that they were fitted without.

    They are those after 1 step, and up to the horizon at which shares of the error are measured. None where the log is
    too short to leave any out.
    """
    out = left_out(problem)
    if out is None:
        return None
    theta = fits_left_out(problem, fit, linearisation, selected, out)
    return at_horizons(problem, predict(problem, theta, last=DECISIVE).error ** 2)


def change_of(before: Errors, after: Errors) -> Change:
    """Return the change from the errors `before` to those `after` of the same predictions.

    Each channel and horizon is scaled by the mean square of `before`, so that all weigh the same. Blocks of time enter
    by the logarithm of their ratio: otherwise a few would decide on an unstable drift.
    """
    old, new = before.squares[:, 1:], after.squares[:, 1:]
    there = np.isfinite(old)
    if np.isinf(new[there]).any() or np.isnan(new[there]).mean() > LOST:  # the car diverges
        return Change(np.inf, 0.0, np.full(3, np.inf), np.zeros(3))
    known = np.isfinite(old) & np.isfinite(new)
    num = np.maximum(known.sum(axis=0), 1)
    unit = np.where(known, old, 0.0).sum(axis=0) / num
    scaled = [np.where(known, one / np.where(unit > 0, unit, 1.0), 0.0) for one in (old, new)]
    names = np.unique(before.block, return_inverse=True)[1]
    pieces = np.unique(before.piece)
    cluster = np.searchsorted(pieces, before.piece) if len(pieces) >= CLUSTERS else names
    first = np.unique(names, return_index=True)[1]
    old, new = (_sums(names, one.sum(axis=1)) for one in scaled)
    count, cluster = _sums(names, known.sum(axis=1)), cluster[first]
    each = _mean_log(old, new, count, cluster)
    together = (one.sum(axis=1, keepdims=True) for one in (old, new, count))
    total = _mean_log(*together, cluster=cluster)
    return Change(float(total[0][0]), float(total[1][0]), *each)


def _sums(names: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the sums (blocks, c) of `values` (n, c) by block."""
    return np.stack([np.bincount(names, column) for column in values.T], axis=1)


def _mean_log(
    old: np.ndarray, new: np.ndarray, count: np.ndarray, cluster: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return means (c,) of half the logarithm of new / old (blocks, c), weighted by `count`, with standard errors."""
    there = (old > 0) & (new > 0)
    change = 0.5 * np.log(np.where(there, new, 1.0) / np.where(there, old, 1.0))
    weight = count * there / np.maximum((count * there).sum(axis=0), 1)
    mean = (weight * change).sum(axis=0)
    off = np.zeros((cluster.max() + 1, old.shape[1]))
    np.add.at(off, cluster, weight * (change - mean))
    n = np.maximum(len(np.unique(cluster)), 2)
    return mean, np.sqrt((off**2).sum(axis=0) * n / (n - 1))
