"""Consistency of the channels of a log, independent of the car: slopes, offsets, time shifts."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from driftjax.logs.checks import SLOW
from driftjax.logs.log import Run
from driftjax.logs.sampling import Channels, fill_gaps, surrounding

WINDOW = 0.25  # over which channels are smoothed and differentiated, all alike [s]
MAX_SHIFT = 0.5  # largest time shift, either way [s]
MAX_LATERAL_ACCELERATION = 2.0  # up to which a car goes where its wheels point [m/s^2]
MIN_SAMPLES = 50  # samples that a check needs
PARTS = 10  # of a log, left out in turn
QUANTILE = 2.262  # 97.5 % quantile of Student's t with PARTS - 1 degrees of freedom


class Agreement(NamedTuple):
    """Regression of a channel on its prediction from others: channel = slope x other + offset, `shift` later."""

    channel: str
    other: str  # in words
    unit: str
    num: int  # samples compared
    slope: float
    offset: float  # [unit]
    rest: float  # RMS residual [unit]
    correlation: float
    shift: float  # by which the channel is late [s]
    shift_half_width: float  # of its 95 % interval [s]


class Check(NamedTuple):
    """A channel and the quantity that it should equal."""

    channel: str
    other: str
    unit: str
    needs: tuple[str, ...]  # further columns
    pair: Callable[[Channels, Channels], tuple[np.ndarray, np.ndarray]]  # from values and rates


def _course(y: Channels, rate: Channels) -> tuple[np.ndarray, np.ndarray]:
    """Return the sideslip, and the course less the heading."""
    return y["beta"], _course_less_heading(y, rate)


def _course_less_heading(y: Channels, rate: Channels) -> np.ndarray:
    angle = np.arctan2(rate["y"], rate["x"]) - y["psi"]
    return np.angle(np.exp(1j * angle))


def _along(y: Channels, rate: Channels) -> np.ndarray:
    return rate["V"] * np.cos(y["beta"]) - y["V"] * (rate["beta"] + y["r"]) * np.sin(y["beta"])


def _across(y: Channels, rate: Channels) -> np.ndarray:
    return rate["V"] * np.sin(y["beta"]) + y["V"] * (rate["beta"] + y["r"]) * np.cos(y["beta"])


def _axle_check(axle: str, left: str, right: str) -> Check:
    """Return the check of the speed against the mean of an axle's wheels, at low lateral acceleration."""
    pair = lambda y, rate: (_gentle(y, y["V"]), (y[left] + y[right]) / 2)
    return Check("V", f"{axle} wheels; slope: radius [m]", "m/s", (left, right), pair)


def _gentle(y: Channels, values: np.ndarray) -> np.ndarray:
    """Return the `values` at low lateral acceleration, NaN elsewhere."""
    return np.where(np.abs(y["V"] * y["r"]) < MAX_LATERAL_ACCELERATION, values, np.nan)


CHECKS = (
    Check("V", "speed of the position", "m/s", ("x", "y"), lambda y, rate: (y["V"], np.hypot(rate["x"], rate["y"]))),
    Check("beta", "course less heading", "rad", ("beta", "x", "y", "psi"), _course),
    Check("r", "rate of the heading", "rad/s", ("psi",), lambda y, rate: (y["r"], rate["psi"])),
    Check("ax", "V' cos(beta) - V (beta' + r) sin(beta)", "m/s^2", ("ax",), lambda y, dy: (y["ax"], _along(y, dy))),
    Check("ay", "V' sin(beta) + V (beta' + r) cos(beta)", "m/s^2", ("ay",), lambda y, dy: (y["ay"], _across(y, dy))),
    _axle_check("front", "wfl", "wfr"),
    _axle_check("rear", "wrl", "wrr"),
    Check("r", "rear wheels; slope: radius / track", "rad/s", ("wrl", "wrr"),
          lambda y, rate: (y["r"], y["wrr"] - y["wrl"])),
)  # fmt: skip


WITHOUT_SIDESLIP = Check(
    "ay", "V r, as no sideslip is known", "m/s^2", ("ay",), lambda y, dy: (y["ay"], y["V"] * y["r"])
)


def steering_check(wheelbase: float) -> Check:
    """Return the check of the yaw rate against V tan(delta) / L at low lateral acceleration."""

    def pair(y: Channels, rate: Channels) -> tuple[np.ndarray, np.ndarray]:
        return _gentle(y, y["r"]), y["V"] * np.tan(y["delta"]) / wheelbase

    return Check("r", f"V tan(delta) / L below {MAX_LATERAL_ACCELERATION:g} m/s^2", "rad/s", (), pair)


def agreements(runs: Sequence[Run], wheelbase: float | None = None) -> list[Agreement]:
    """Return every check whose columns all `runs` have; the steering check needs the wheelbase [m]."""
    has = set.intersection(*(set(run.extra) | ({"beta"} if np.isfinite(run.beta).any() else set()) for run in runs))
    smoothed = [smooth_channels(run) for run in runs]
    sideslip_known = any(np.isfinite(y["beta"]).any() for y, _ in smoothed)
    checks = [check for check in (*CHECKS, *(WITHOUT_SIDESLIP,) * (not sideslip_known)) if set(check.needs) <= has]
    checks += [] if wheelbase is None else [steering_check(wheelbase)]
    evaluated = [evaluate_check(check, [check.pair(*one) for one in smoothed], runs[0].dt) for check in checks]
    return [one for one in evaluated if one is not None]


def smooth_channels(run: Run) -> tuple[Channels, Channels]:
    """Return the channels of a run and their rates, as `smooth_with_rate` does; NaN at low speed too.

    A sideslip that was not measured is that of the pose, where there is one.
    """
    V = fill_gaps(run.V)
    fast = V > SLOW * V.max()
    steered = run.delta - run.command_changes[:, 0] / 2  # at the sample
    raw = {"V": run.V, "beta": run.beta, "r": run.r, "delta": steered} | run.extra
    smoothed = lambda y: [np.where(fast, one, np.nan) for one in smooth_with_rate(y, run.dt)]
    both = {name: smoothed(y) for name, y in raw.items()}
    y, rate = ({name: pair[i] for name, pair in both.items()} for i in range(2))
    if not np.isfinite(run.beta).any() and {"x", "y", "psi"} <= set(y):
        y["beta"], rate["beta"] = smoothed(_course_less_heading(y, rate))
    return y, rate


def smooth_with_rate(y: np.ndarray, dt: float, window: float = WINDOW, order: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return values and rates (n,) of `y` (n,) by polynomials over `window` [s]; NaN in gaps or if `y` is shorter."""
    from scipy.signal import savgol_filter  # takes a second to load, with every command and worker that reads logs

    num = max(2 * round(window / dt / 2) + 1, 5)
    if len(y) < num:
        return np.full(len(y), np.nan), np.full(len(y), np.nan)
    keep, filled = near_measurements(y, num // 2), fill_gaps(y)
    of = lambda derivative: np.where(keep, np.asarray(savgol_filter(filled, num, order, derivative, dt)), np.nan)
    return of(0), of(1)


def near_measurements(values: np.ndarray, num: int) -> np.ndarray:
    """Return whether each sample of `values` (n,) lies between measurements at most `num` samples apart, or on one."""
    last, following = surrounding(np.isfinite(values))
    return (last >= 0) & (following < len(values)) & (following - last <= num)


def evaluate_check(check: Check, pairs: list[tuple[np.ndarray, np.ndarray]], dt: float) -> Agreement | None:
    """Evaluate one check over all runs; None if there are too few samples or a channel is constant."""
    y, x = (np.concatenate(column) for column in zip(*pairs, strict=True))
    both = np.isfinite(y) & np.isfinite(x)
    if both.sum() < MIN_SAMPLES or np.ptp(x[both]) == 0 or np.ptp(y[both]) == 0:
        return None
    if np.isnan((shift := time_shift(pairs, dt)).value):
        return None
    slope, offset = np.polyfit(x[both], y[both], 1)
    rest = float(np.sqrt(np.mean((y - slope * x - offset)[both] ** 2)))
    correlation = float(np.corrcoef(x[both], y[both])[0, 1])
    return Agreement(check.channel, check.other, check.unit, int(both.sum()), float(slope), float(offset), rest,
                     correlation, *shift)  # fmt: skip


class TimeShift(NamedTuple):
    """Time by which a channel follows another, with a 95 % interval."""

    value: float  # [s]; NaN where too few samples are left to shift
    half_width: float  # [s]; NaN where too few are left without a part


def time_shift(pairs: list[tuple[np.ndarray, np.ndarray]], dt: float) -> TimeShift:
    """Return the time by which the first channel of each pair follows the second: that of the largest correlation.

    Its interval is from the shifts without each of `PARTS` parts of the log (jackknife; Efron and Tibshirani 1993, Ch.
    11). It is wide where the channels have a trend in common, and nothing else.
    """
    most = max(round(MAX_SHIFT / dt), 1)
    shifts = np.arange(-most, most + 1)
    score = np.stack([_correlations(pairs, int(k), most) for k in shifts])
    value, *without = (_vertex(shifts * dt, one) for one in score.T)
    return TimeShift(value, float(QUANTILE * np.sqrt((PARTS - 1) * np.var(without))))


def _vertex(shifts: np.ndarray, score: np.ndarray) -> float:
    """Return the shift of the largest `score`, at the vertex of the parabola through it and its neighbours.

    NaN where no score is known.
    """
    if np.isnan(score).all():
        return np.nan
    k = int(np.nanargmax(score))
    if not 0 < k < len(score) - 1:
        return float(shifts[k])
    left, middle, right = score[k - 1 : k + 2]
    bend = left - 2 * middle + right
    return float(shifts[k] + (0.5 * (left - right) / bend if bend < 0 else 0.0) * (shifts[1] - shifts[0]))


def _correlations(pairs: list[tuple[np.ndarray, np.ndarray]], k: int, most: int) -> np.ndarray:
    """Return the correlation of y(t + k) with x(t) over all runs, and without each of `PARTS` parts (1 + PARTS,).

    All shifts share their samples; NaN where these are too few.
    """
    rows = [np.zeros((2, 0))]
    for y, x in pairs:
        if len(y) > 2 * most:
            at = np.arange(most, len(y) - most)
            rows.append(np.stack([y[at + k], x[at]]))
    y, x = np.concatenate(rows, axis=1)
    part, both = np.arange(len(y)) * PARTS // max(len(y), 1), np.isfinite(y) & np.isfinite(x)
    y, x, part = y[both], x[both], part[both]
    if len(y) < MIN_SAMPLES:
        return np.full(1 + PARTS, np.nan)
    y, x = y - y.mean(), x - x.mean()
    each = np.stack([np.bincount(part, one, PARTS) for one in (np.ones(len(y)), y, x, y * y, x * x, y * x)])
    num, y, x, yy, xx, yx = np.sum(each, axis=1)[:, None] - np.column_stack([np.zeros(6), each])
    with np.errstate(invalid="ignore", divide="ignore"):  # where what is left is constant
        r = (num * yx - y * x) / np.sqrt((num * yy - y**2) * (num * xx - x**2))
    return np.where(num < MIN_SAMPLES, np.nan, r)
