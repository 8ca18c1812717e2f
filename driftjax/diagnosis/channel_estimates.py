"""Estimate the sideslip of logs without one, and find which channels a log has."""

import numpy as np

from driftjax.logs import Run
from driftjax.logs.sampling import fill_gaps
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.single_track import G

SLOWEST = 0.1  # speed below which yaw rate over speed means nothing [sqrt(gL)]


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
