"""Checks of measured runs; each error is one sentence that names the file, the row or column, and the remedy."""

from collections.abc import Mapping

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.columns import CHANNELS, COMMANDS, MEASURED, OPTIONAL, dispensable
from driftjax.logs.raw import RawRun
from driftjax.logs.sampling import JITTER, UNIFORM, even_rate, jitter, proposed_rate, sample_time

MAX_ANGLE = 1.6  # rad
MAX_YAW_RATE = 20.0  # rad/s
MAX_SAMPLE_TIME = 1.0  # s
STUCK_ROWS = 20
SLOW = 0.1  # share of a run's top speed below which its angles of motion are noise


def check_time(run: RawRun, rate: float | None) -> float:
    """Return the sample time [s] of a run of two rows or more; for uneven steps, the one they are resampled to.

    Raises `BadInput` if time does not increase, or if the steps are uneven and no `rate` [Hz], or too high a one, says
    what to resample them to.
    """
    t, label = run.values["t"], run.labels["t"]
    remedy = "time must increase within a run: sort the rows, or name each run in a column of its own"
    run.reject("t", np.append(False, np.diff(t) <= 0), "s, no more than in the row before", remedy)
    dt = sample_time(t)
    if dt > MAX_SAMPLE_TIME:
        raise BadInput(f"{run.where}: {label} steps by {dt:g}, which looks like milliseconds; write seconds.")
    if (often := even_rate(t)) is None:
        return dt
    if rate is None or rate > often:
        raise BadInput(
            f"{run.where}: the steps of {label} vary by {100 * jitter(t, dt):.0f} % around {dt:.4g} s, more than "
            f"{100 * JITTER:.0f} %; write 'rate: {proposed_rate(often):g}' in a column map to resample the log evenly."
        )
    return 1 / rate


def invalid_sideslip(run: RawRun) -> np.ndarray:
    """Return where beta is invalid: beyond a right angle near standstill.

    If beta was computed from vx, vy, whose unit is certain, at any speed: the car rolls backwards.
    """
    V = np.nan_to_num(run.values["V"])
    doubtful = V < SLOW * V.max(initial=0.0) if run.beta_mapped else np.ones(V.shape, bool)
    return (np.abs(run.values["beta"]) > MAX_ANGLE) & doubtful


def check_values(run: RawRun) -> None:
    """Raise `BadInput` if a channel is empty, stuck, negative or in another unit."""
    may_lack = dispensable(run.values)
    for name in CHANNELS[1:]:
        values = run.values[name][np.isfinite(run.values[name])]
        if not values.size and name in may_lack:
            continue
        if not values.size:
            raise BadInput(f"{run.where}: {run.labels[name]} has no value in any row; fill it in or leave the run out.")
        if name in MEASURED and values.size > STUCK_ROWS and np.ptp(values) == 0:
            raise BadInput(
                f"{run.where}: {run.labels[name]} is {values[0]:g} in all {values.size} rows, "
                "which looks like a stuck sensor; mend the column or leave the run out."
            )
    values = run.values
    remedy = "speed is not negative: leave out rows driven backwards"
    run.reject("V", values["V"] < 0, "m/s", remedy)
    remedy = "this looks like degrees: write radians, or give a column map with a factor"
    run.reject("beta", np.abs(values["beta"]) > MAX_ANGLE, "rad", remedy)
    run.reject("delta", np.abs(values["delta"]) > MAX_ANGLE, "rad", remedy)
    remedy = "this looks like degrees per second: write radians per second, or give a column map with a factor"
    run.reject("r", np.abs(values["r"]) > MAX_YAW_RATE, "rad/s", remedy)


def count_missing(run: RawRun) -> str:
    """Return the number of missing values per channel as `2 of V, 5 of delta`; empty if none."""
    counts = {name: int(np.isnan(run.values[name]).sum()) for name in (*MEASURED, *COMMANDS)}
    absent = {name for name in OPTIONAL if counts[name] == len(run.lines)}
    return ", ".join(f"{count} of {name}" for name, count in counts.items() if count and name not in absent)


def check_rates(sample_times: Mapping[str, float]) -> None:
    """Raise `BadInput` if two of the named runs differ in sample rate by more than 1 %."""
    (first, reference), *others = sample_times.items()
    for name, dt in others:
        if abs(reference / dt - 1) > UNIFORM:
            raise BadInput(
                f"Run '{first}' has {1 / reference:.4g} Hz but run '{name}' has {1 / dt:.4g} Hz; "
                "thin them to one rate (key 'rate' of a column map), or read them in calls of their own."
            )
