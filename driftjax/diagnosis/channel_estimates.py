"""Estimate sideslip and acceleration for logs without sideslip or drive force, from the other channels."""

import numpy as np

from driftjax.logs import Run
from driftjax.logs.agreement import WINDOW, smooth_with_rate
from driftjax.logs.sampling import fill_gaps
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.single_track import G

SLOWEST = 0.1  # speed below which yaw rate over speed means nothing [sqrt(gL)]
SLOW = 1.0  # time over which accelerometers are believed [s]


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


def inertial_force(vehicle: VehicleConfig, run: Run, beta: np.ndarray) -> np.ndarray:
    """Return mass times the rate (n,) of the speed [N], at most friction times weight, for a car `by_acceleration`.

    `beta` (n,) is the sideslip for accelerometers.
    """
    most, rate = vehicle.mu * vehicle.m * G, acceleration(run, beta)
    over_step = (rate + np.append(rate[1:], rate[-1])) / 2  # commands are held from sample to sample
    return np.clip(vehicle.m * over_step, -most, most)


def acceleration(run: Run, beta: np.ndarray) -> np.ndarray:
    """Return the rate (n,) [m/s^2] of the speed, smoothed, with the fast part from accelerometers.

    Slow errors of the accelerometers, such as a bias, are left to the speed (complementary filter, Higgins 1975).
    """
    at_once, window = np.zeros(len(run.t)), WINDOW
    if {"ax", "ay"} <= set(run.extra):
        ax, ay = (fill_gaps(run.extra[name]) for name in ("ax", "ay"))
        at_once, window = ax * np.cos(beta) + ay * np.sin(beta), SLOW
    rest = run.V - np.cumsum(at_once) * run.dt
    return fill_gaps(smooth_with_rate(rest, run.dt, window)[1]) + at_once
