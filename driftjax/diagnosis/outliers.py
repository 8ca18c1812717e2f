"""Find outliers: single samples of a sensor that differ from both neighbours by much more than its noise.

Yaw rates that no car reaches are outliers at any rate, as where a heading that was differentiated jumps by 2 pi.

They contain nothing about the car and are removed before anything is fitted (Hampel 1985), so that no hypothesis can
gain by explaining them. A car's own motion lasts for several samples; a step, or a value that is held, differs from one
neighbour only.
"""

import dataclasses

import numpy as np

from driftjax.diagnosis.noise import robust_deviation
from driftjax.logs import Run
from driftjax.logs.columns import MEASURED
from driftjax.logs.sampling import fill_gaps
from driftjax.vehicle.single_track import G

THRESHOLD = 5.0  # robust deviations of a sample from its neighbours, from which it is an outlier
ALIKE = 0.4  # distance from one neighbour over that from the other, at least
PASSES = 3  # since outliers side by side hide each other
NEIGHBOURS = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6  # weights of the cubic through them
RESOLVED = 8.0  # samples in sqrt(L/g) from which they resolve the motion of a car
IMPOSSIBLE = 3.0  # yaw rate over the largest speed of a run, or sqrt(gL) if that is more [1/L]: a spin stays below 1
MIN_LENGTH = 20  # samples of a run below which nothing is an outlier


def outliers(y: np.ndarray) -> np.ndarray:
    """Return which samples of a channel `y` (n,), NaN where missing, are outliers."""
    marked = np.zeros(len(y), bool)
    if np.isfinite(y).sum() < MIN_LENGTH:
        return marked
    for _ in range(PASSES):
        clean = fill_gaps(np.where(marked, np.nan, y))
        new = _stand_alone(clean) & np.isfinite(y) & ~marked
        if not new.any():
            break
        marked |= new
    return marked


def _stand_alone(y: np.ndarray) -> np.ndarray:
    """Return which samples (n,) deviate from both neighbours to the same side, and from the cubic through four.

    By more than noise does, and by more than a few steps of the quantisation.
    """
    change = np.diff(y)
    before, after = change[1:-2], -change[2:-1]
    least, most = np.sort(np.abs([before, after]), axis=0)
    off = np.convolve(y, np.eye(5)[2] - NEIGHBOURS, "valid")
    steps = np.abs(change[change != 0])
    limit = THRESHOLD * max(robust_deviation(off), steps.min(initial=np.inf))
    alike = (np.sign(before) == np.sign(after)) & (least > ALIKE * most)
    return np.pad(alike & (least > limit) & (np.abs(off) > limit), 2)


def without_outliers(run: Run, wheelbase: float) -> Run:
    """Return the run with outliers of V, beta and r missing, for a car of this `wheelbase` [m]."""
    rows = {name: np.where(where, np.nan, getattr(run, name)) for name, where in find_outliers(run, wheelbase).items()}
    return dataclasses.replace(run, **rows)


def find_outliers(run: Run, wheelbase: float) -> dict[str, np.ndarray]:
    """Return which samples (n,) of V, beta and r are outliers; where samples are sparse, only impossible ones."""
    resolved = run.dt * RESOLVED <= np.sqrt(wheelbase / G)
    marked = {name: outliers(getattr(run, name)) & resolved for name in MEASURED}
    fastest = max(np.nanmax(run.V, initial=0.0), np.sqrt(G * wheelbase))
    return marked | {"r": marked["r"] | (np.abs(run.r) * wheelbase > IMPOSSIBLE * fastest)}


def count_outliers(runs: tuple[Run, ...], wheelbase: float) -> dict[str, int]:
    """Return the number of outliers of each channel in `runs`."""
    marked = [find_outliers(run, wheelbase) for run in runs]
    return {name: sum(int(one[name].sum()) for one in marked) for name in MEASURED}
