"""Estimate sideslip and heading of logs without them, and find which channels a log has."""

import dataclasses
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


def integrated_yaw_rate(run: Run) -> np.ndarray:
    """Return the integral (n,) of the yaw rate of a run [rad]."""
    return np.cumsum(fill_gaps(run.r)) * run.dt


def with_turned(runs: Sequence[Run]) -> tuple[Run, ...]:
    """Return the runs, if none has a heading, with the integral of the yaw rate beside each.

    It tells how the car faces wind and slopes, if all drives begin in one direction: it is 0 where a drive begins, and
    goes on where a run follows the one before it.
    """
    if any({"psi", TURNED} & set(run.extra) for run in runs):
        return tuple(runs)
    turned, before = [], None
    for run in runs:
        follows = before is not None and 0 < run.t[0] - before.t[-1] <= CONTIGUOUS * run.dt
        psi = integrated_yaw_rate(run) + (turned[-1].extra[TURNED][-1] if follows else 0.0)
        turned.append(dataclasses.replace(run, extra=run.extra | {TURNED: psi}))
        before = run
    return tuple(turned)
