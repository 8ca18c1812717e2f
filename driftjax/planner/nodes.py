"""Place the nodes of a plan along a track, and mark those of the lap."""

import math
from typing import NamedTuple

import numpy as np

from driftjax.core import BadInput
from driftjax.planner.config import PlanConfig
from driftjax.track import Track

FEWEST = 301
SPACING = 0.15  # wheelbases; keeps the explicit Runge-Kutta steps stable at drifting speeds


class Nodes(NamedTuple):
    """Even nodes, and the first and last one of the lap."""

    s: np.ndarray  # [m]; on a closed track they go on beyond one lap
    first: int
    last: int


def nodes(track: Track, wheelbase: float, config: PlanConfig) -> Nodes:
    """Place the nodes of an open track from end to end, of a closed one over a lap with run-up and run-out.

    A closed lap starts rolling in the middle of its longest straight, is cut in the middle of a later straight, and
    runs out to a still later one, so that neither the start nor the finish affects the lap.
    """
    length = float(track.length)
    if not track.closed:
        num = config.num_nodes or max(FEWEST, math.ceil(length / (SPACING * wheelbase)) + 1)
        return Nodes(np.linspace(0.0, length, num), 0, num - 1)
    start, cut, end = _straights(track, config.lead / 2)
    total = length + end
    num = config.num_nodes or max(FEWEST, math.ceil(total / (SPACING * wheelbase)) + 1)
    per_lap = round((num - 1) * length / total)
    ds = length / per_lap  # so that a lap is a whole number of steps
    first = round(cut / ds)
    if first + per_lap >= num:
        raise BadInput(f"key 'num_nodes' is {num}; this lap with its run-up and run-out needs more.")
    return Nodes(start + ds * np.arange(num), first, first + per_lap)


def _straights(track: Track, lead: float) -> tuple[float, float, float]:
    """Return the middle of the longest straight, and the distances to two later middles, `lead` laps apart [m]."""
    kappa, length = np.abs(np.asarray(track.kappa)), float(track.length)
    n = len(kappa)
    straight = kappa <= 0.1 * kappa.max()
    if not straight.any():
        raise BadInput("track: a closed lap without a straight has no place to start; give one with a straight.")
    shift = int(np.argmin(straight))  # roll so that no straight lies across the seam
    rolled = np.concatenate([[False], np.roll(straight, -shift), [False]])
    edges = np.flatnonzero(rolled[1:] != rolled[:-1])
    begin, end = edges[::2], edges[1::2]
    middle, size = ((begin + end) / 2 + shift) * length / n, end - begin
    longest = int(np.argmax(size))
    ahead = np.sort((middle - middle[longest])[size >= 0.2 * size[longest]] % length)
    ahead = np.concatenate([ahead, ahead + length, ahead + 2 * length])
    cut = ahead[ahead >= lead * length].min()
    return float(middle[longest] % length), float(cut), float(ahead[ahead >= cut + lead * length].min())
