"""The gap between two logs: how much worse the car of one log predicts the other one than that log's own car.

The own car, and the car of the other log in which only the named differences are changed, are fitted without the part
of the log that they predict.
"""

from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.contrast import Pair
from driftjax.diagnosis.cross_validate import fits_left_out, left_out
from driftjax.diagnosis.fit import Fit, Problem, evaluate_fit
from driftjax.diagnosis.gain import (
    DECISIVE,
    RESAMPLES,
    TINY,
    Errors,
    Share,
    at_horizons,
    channel_ratios,
    predict,
    ratios,
)
from driftjax.diagnosis.refine import refit_to_convergence
from driftjax.diagnosis.runs import Linearisation
from driftjax.logs import Run
from driftjax.logs.columns import CHANNELS, MEASURED

BINS = 20  # of the range of a channel, of which two logs share some
TAILS = (0.5, 99.5)  # percentiles that bound this range


class Gap(NamedTuple):
    """Open-loop prediction errors on one log."""

    models: dict[str, Errors]  # nominal, other, corrected and own car
    ratio: dict[str, np.ndarray]  # (horizons, 4, 3) of errors over those of the own car, with interval; V, beta, r, all
    closed: Share | None  # of the excess error of the other car, by the corrected one; None where no run is long enough
    held_out: bool  # whether own and corrected car are fitted without what they predict

    @property
    def decisive(self) -> np.ndarray:
        """Return the error of the other car over that of the own one at the decisive horizon, with interval (3,)."""
        return self.ratio["other"][DECISIVE, -1]


def measure_gap(pair: Pair, where: int, selected: tuple[int, ...], seed: int) -> Gap:
    """Measure the errors on log number `where` of `pair` (0 or 1); `selected` are the named differences."""
    problem, theta = pair.problems[where], pair.fits[1 - where].theta
    out = left_out(problem)
    about = problem._replace(start=theta)
    corrected, linearisation = refit_to_convergence(about, evaluate_fit(about, theta), problem.columns(selected))
    thetas = {
        "nominal": problem.start,
        "other": theta,
        "corrected": _without(about, corrected, linearisation, selected, out),
        "own": _without(problem, pair.fits[where], pair.linearisations[where], pair.effects, out),
    }
    models = {name: at_horizons(problem, predict(problem, theta).error ** 2) for name, theta in thetas.items()}
    own = models["own"]
    closed = closed_share(models["other"], models["corrected"], own, seed)
    return Gap(models, {name: _ratio(own, one, seed) for name, one in models.items()}, closed, out is not None)


def closed_share(other: Errors, corrected: Errors, own: Errors, seed: int) -> Share | None:
    """Return how much of the squared error of `other` beyond that of `own` the `corrected` car removes.

    At the decisive horizon, each channel scaled by the mean square of `own`, with intervals over blocks of time. The
    remaining error of the corrected car is the sum over channels: one that it predicts better makes up for one that it
    predicts worse. None where no run lasts that long.
    """
    squares = np.stack([one.squares[:, DECISIVE] for one in (own, other, corrected)])
    squares = squares[..., np.isfinite(squares).any(axis=1).all(axis=0)]  # channels that the log has
    keep = np.isfinite(squares).all(axis=(0, 2))
    if not squares.shape[2] or not keep.any():
        return None
    scaled = (squares[:, keep] / squares[0, keep].mean(axis=0)).sum(axis=2)
    block = np.unique(own.block[keep], return_inverse=True)[1]
    sums = np.stack([np.bincount(block, row) for row in scaled], axis=1)
    draws = np.random.default_rng(seed).integers(0, len(sums), (RESAMPLES, len(sums)))
    mine, theirs, mended = np.moveaxis(np.concatenate([sums.sum(axis=0)[None], sums[draws].sum(axis=1)]), 1, 0)
    interval = lambda values: (float(values[0]), tuple(np.percentile(values[1:], [2.5, 97.5]).tolist()))
    left = interval(np.maximum(mended - mine, 0.0) / mended)
    if np.percentile((theirs - mine)[1:], 2.5) <= 0:  # whether there is a gap is in doubt
        return Share(np.nan, (np.nan, np.nan), *left)
    return Share(*interval(1 - (mended - mine) / np.maximum(theirs - mine, TINY * mine)), *left)


def _without(
    problem: Problem, fit: Fit, linearisation: Linearisation, effects: tuple[int, ...], out: np.ndarray | None
) -> np.ndarray:
    """Return the parameters of `fit`, or for each piece (P, K) those fitted without the blocks `out`."""
    return fit.theta if out is None else fits_left_out(problem, fit, linearisation, effects, out)


def _ratio(own: Errors, other: Errors, seed: int) -> np.ndarray:
    """Return the RMS errors of `other` over `own` (horizons, 4, 3), with intervals: of V, beta, r and all."""
    each = [channel_ratios(own, other, seed, at) for at in range(len(own.horizons))]
    return np.concatenate([np.stack(each), ratios(own, other, seed)[:, None]], axis=1)


class Overlap(NamedTuple):
    """Ranges of one channel in two logs (5th to 95th percentile, SI), and the share of samples within both."""

    first: tuple[float, float]
    second: tuple[float, float]
    share: float  # area that the two distributions have in common, 0 to 1


def overlaps(first: tuple[Run, ...], second: tuple[Run, ...]) -> dict[str, Overlap]:
    """Return the overlap of V, beta, r and both commands, as far as both logs have them."""
    shared = {}
    for name in CHANNELS[1:]:
        a, b = (np.concatenate([getattr(run, name) for run in runs]) for runs in (first, second))
        a, b = (one[np.isfinite(one)] for one in (a, b))
        if not len(a) or not len(b):
            continue
        low, high = np.percentile(np.concatenate([a, b]), TAILS)
        edges = np.linspace(low, high, BINS + 1)
        edges[[0, -1]] = -np.inf, np.inf
        of_a, of_b = (np.histogram(one, edges)[0] / len(one) for one in (a, b))
        ends = lambda one: (float(np.percentile(one, 5)), float(np.percentile(one, 95)))
        shared[name] = Overlap(ends(a), ends(b), float(np.minimum(of_a, of_b).sum()))
    return shared


def gap_json(gap: Gap) -> dict:
    """Return the content of compare.json on the gap on one log."""
    channels = (*MEASURED, "all")
    table = lambda values: {name: values[:, i].tolist() for i, name in enumerate(channels)}
    return {
        "horizons_s": list(gap.models["own"].horizons),
        "decisive_horizon_s": gap.models["own"].horizons[DECISIVE],
        "held_out": gap.held_out,
        "rmse": {name: {c: one.rms[:, i].tolist() for i, c in enumerate(MEASURED)} for name, one in gap.models.items()},
        "ratio_to_own": {name: table(one[..., 0]) for name, one in gap.ratio.items()},
        "ratio_ci95": {name: table(one[..., 1:]) for name, one in gap.ratio.items()},
        "closed": None if gap.closed is None else gap.closed._asdict(),
    }
