"""Estimate sideslip and heading of logs without them, and find which channels a log has."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from driftjax.logs import Run
from driftjax.logs.sampling import fill_gaps
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.single_track import G

SLOWEST = 0.1  # speed below which yaw rate over speed means nothing [sqrt(gL)]
TURNED = "turned"  # column of the integral of the yaw rate, which no sensor measures [rad]
CONTIGUOUS = 1.5  # sample times from the end of one part of a drive to the start of the next


def has_sideslip(run: Run) -> bool:
    """Return whether the sideslip was measured at all."""
    return bool(np.isfinite(run.beta).any())


def has_force(run: Run) -> bool:
    """Return whether the longitudinal force was measured or commanded."""
    return bool(np.isfinite(run.Fxr).any())


def sideslip(vehicle: VehicleConfig, run: Run) -> np.ndarray:
    """Return the sideslip (n,) [rad] without gaps; if not measured, that of a rolling rear axle."""
    if has_sideslip(run):
        return fill_gaps(run.beta)
    slowest = SLOWEST * np.sqrt(G * (vehicle.a + vehicle.b))
    return np.arctan(vehicle.b * fill_gaps(run.r) / np.maximum(fill_gaps(run.V), slowest))


def with_turned(runs: Sequence[Run]) -> tuple[Run, ...]:
    """Return the runs with the integral of the yaw rate beside each, if they are one drive without a heading.

    It tells how the car faces wind and slopes, from the start of the drive on. Of several drives, whose first headings
    are unknown, none is given.
    """
    apart = [after.t[0] - before.t[-1] for before, after in itertools.pairwise(runs)]
    one_drive = all(0 < gap <= CONTIGUOUS * runs[0].dt for gap in apart)
    if not one_drive or any({"psi", TURNED} & set(run.extra) for run in runs):
        return tuple(runs)
    turned = np.cumsum(np.concatenate([fill_gaps(run.r) for run in runs])) * runs[0].dt
    parts = np.split(turned, np.cumsum([len(run.t) for run in runs])[:-1])
    pairs = zip(runs, parts, strict=True)
    return tuple(dataclasses.replace(run, extra=run.extra | {TURNED: part}) for run, part in pairs)
