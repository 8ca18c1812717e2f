"""Prepare a log for a diagnosis: a yaw rate or heading where it has none, and no more samples than the car needs."""

import dataclasses

import numpy as np

from driftjax.core import BadInput
from driftjax.diagnosis.channel_estimates import with_turned
from driftjax.logs import Log, Run
from driftjax.logs.agreement import smooth_with_rate
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.single_track import G

RESOLUTION = 40.0  # samples in sqrt(L/g) that resolve a car: its fastest motion takes a tenth of that time


def resolved_log(vehicle: VehicleConfig, log: Log) -> Log:
    """Return the log with yaw rate and heading, without more samples than the motion of a car of this size needs.

    For a wheelbase of 2.65 m these are 77 Hz or a little more. Others cost time, and what differs from one to the next
    is the sensor's filter rather than the car. Raises `BadInput` as `with_yaw_rate` does.
    """
    log = with_yaw_rate(log.thin(RESOLUTION / np.sqrt((vehicle.a + vehicle.b) / G)))
    return dataclasses.replace(log, runs=with_turned(log.runs))


def with_yaw_rate(log: Log) -> Log:
    """Return the log with the rate of the heading as the yaw rate of runs without one; a note says so.

    What a sensor reads is the true value and noise that does not depend on it, and so must be what stands for it:
    cubics over five samples. A smoothing spline, which errs least, and longer windows lack some of the motion, and that
    was named as effects of the car. Raises `BadInput` for a run without yaw rate and heading.
    """
    lacking = {run.name for run in log.runs if not np.isfinite(run.r).any()}
    if not lacking:
        return log
    runs = tuple(_with_rate_of_heading(run) if run.name in lacking else run for run in log.runs)
    note = f"The yaw rate of {len(lacking)} runs is the rate of their heading."
    return dataclasses.replace(log, runs=runs, notes=(*log.notes, note))


def _with_rate_of_heading(run: Run) -> Run:
    _, r = smooth_with_rate(run.extra.get("psi", run.r), run.dt, 4 * run.dt, order=3)
    if not np.isfinite(r).any():
        raise BadInput(
            f"Run '{run.name}' has neither a yaw rate nor a heading; map r or psi, or leave it out (--runs)."
        )
    return dataclasses.replace(run, r=r, yaw_rate_of_heading=True)
