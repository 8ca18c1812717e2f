"""Time bases of measured runs: sample time, dropouts, gaps, jitter, thinning."""

import numpy as np

from driftjax.core import BadInput

Channels = dict[str, np.ndarray]

HOLD = 3  # samples for which a missing command is held, and sample times that t may jump within a run
HOLD_TIME = 0.1  # and time for which it is, however many samples: loggers of high rates lose several at once [s]
UNIFORM = 0.01  # deviation of the steps from the sample time up to which nothing is resampled
JITTER = 0.20  # deviation up to which linear resampling is fair
REGULAR = 0.95  # share of uneven steps that are no gap
FEWER = 0.8  # rate that is proposed over that of uneven samples
SLACK = 0.5  # sample times by which jitter may stretch a gap


def sample_time(t: np.ndarray) -> float:
    """Return the sample time [s]: mean of the steps of `t` that are not gaps, so rounded time stamps do no harm."""
    steps = np.diff(t)
    middle = float(np.quantile(steps, 0.5, method="lower"))  # a step that there is: two of them may have none between
    return float(f"{np.mean(steps[np.abs(steps - middle) <= SLACK * middle]):.9g}")


def spacing(t: np.ndarray) -> float:
    """Return the interval [s] to the next sample: the sample time, or for uneven steps their `REGULAR` quantile."""
    dt = sample_time(t)
    return dt if jitter(t, dt) <= JITTER else max(float(np.quantile(np.diff(t), REGULAR)), dt)


def jitter(t: np.ndarray, dt: float) -> float:
    """Return the 99 % quantile of the steps' deviation from whole multiples of the sample time [1]."""
    steps = np.diff(t) / dt
    return float(np.quantile(np.abs(steps - np.maximum(np.round(steps), 1)), 0.99))


def even_rate(t: np.ndarray) -> float | None:
    """Return the mean number of samples per second, gaps left out, if the steps of `t` are uneven; None if even."""
    if jitter(t, sample_time(t)) <= JITTER:
        return None
    return float((len(t) - 1) / np.sum(np.minimum(np.diff(t), spacing(t))))


def proposed_rate(rate: float) -> float:
    """Return the rate [Hz] to resample uneven samples of mean `rate` [Hz] to, rounded to two digits."""
    return float(f"{FEWER * rate:.2g}")


def hold_commands(t: np.ndarray, command: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return `command` held over short gaps, as `held_samples` has them, and the mask of rows with a value."""
    there = np.isfinite(command)
    last, following = surrounding(there)
    since = np.append(t, -np.inf)[last]  # -1, none before, reads the end
    until = np.append(t, np.inf)[following]
    held = ~there & (until - since <= (held_samples(dt) + 1 + SLACK) * dt)
    return np.where(held, command[last], command), there | held


def held_samples(dt: float) -> int:
    """Return the samples of sample time `dt` [s] for which a missing command is held: 3, or as many as 0.1 s has."""
    return max(HOLD, int(HOLD_TIME / dt + UNIFORM))


def surrounding(there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the last and next sample marked in `there` (n,), the row included; -1, n if none."""
    index, n = np.arange(len(there)), len(there)
    last = np.maximum.accumulate(np.where(there, index, -1))
    return last, np.minimum.accumulate(np.where(there, index, n)[::-1])[::-1]


def split_at_gaps(t: np.ndarray, dt: float) -> list[slice]:
    """Return the slices of rows between which t jumps by more than 3 sample times and 0.1 s."""
    cuts = np.flatnonzero(np.diff(t) > (held_samples(dt) + SLACK) * dt) + 1
    edges = [0, *cuts.tolist(), len(t)]
    return [slice(start, stop) for start, stop in zip(edges, edges[1:], strict=False)]


def is_uniform(t: np.ndarray, dt: float) -> bool:
    """Return whether every step of `t` is the sample time within 1 %."""
    return bool(np.all(np.abs(np.diff(t) - dt) <= UNIFORM * dt))


def resample_channels(
    t: np.ndarray, values: Channels, held_names: tuple[str, ...], dt: float, every: float | None = None
) -> tuple[np.ndarray, Channels]:
    """Return the channels at every `dt` from the start: samples on the grid unchanged, others interpolated.

    Where samples, which come about `every` [s] (`dt` where left out), are lost, the channels named in `held_names` keep
    their value and the others are missing.
    """
    every = dt if every is None else every
    grid = t[0] + dt * np.arange(int((t[-1] - t[0]) / dt + SLACK) + 1)
    inside = np.minimum(grid, t[-1])  # the last point may lie half a sample time past the last sample

    def at_grid(name: str, y: np.ndarray) -> np.ndarray:
        values = interpolate(inside, t, y, every)
        return (
            np.where(np.isnan(values), sample_and_hold(inside, t, y, every), values) if name in held_names else values
        )

    return grid, {name: at_grid(name, y) for name, y in values.items()}


def interpolate(times: np.ndarray, t: np.ndarray, y: np.ndarray, dt: float) -> np.ndarray:
    """Return `y`, sampled at `t` about every `dt` [s], at `times` by linear interpolation; exact at samples.

    Missing where samples are lost, before the first and after the last one.
    """
    left = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
    after, before = times - t[left], t[left + 1] - times
    values = y[left] + np.clip(after / (after + before), 0, 1) * (y[left + 1] - y[left])
    values = np.where(after + before > (1 + SLACK) * dt, np.nan, values)
    values = np.where(after <= UNIFORM * dt, y[left], np.where(before <= UNIFORM * dt, y[left + 1], values))
    return np.where((after < -UNIFORM * dt) | (before < -UNIFORM * dt), np.nan, values)


def sample_and_hold(times: np.ndarray, t: np.ndarray, y: np.ndarray, dt: float, lost: float = np.inf) -> np.ndarray:
    """Return `y`, sampled at `t` about every `dt` [s], at `times`: the last sample; missing before the first one.

    If more than `lost` samples in a row are lost, the one before them is held for a sample time less jitter.
    """
    last = np.searchsorted(t, times + UNIFORM * dt, side="right") - 1
    following = np.append(t, np.inf)[last + 1]
    bridged = following - t[last] <= (lost + 1 + SLACK) * dt
    there = (last >= 0) & (bridged | (times - t[last] < (1 - JITTER) * dt))
    return np.where(there, y[last], np.nan)


def thin(t: np.ndarray, values: Channels, averaged: tuple[str, ...], factor: int) -> tuple[np.ndarray, Channels]:
    """Return every `factor`-th sample; channels named in `averaged` as the mean until the next returned sample."""
    starts = np.arange(0, len(t), factor)
    counts = np.diff(np.append(starts, len(t)))
    return t[starts], {
        name: np.add.reduceat(y, starts) / counts if name in averaged else y[starts] for name, y in values.items()
    }


def means_to_next(values: np.ndarray) -> np.ndarray:
    """Return the means (n,) of `values` (n,) over the time to the next sample, if they change linearly until there."""
    return np.append((values[1:] + values[:-1]) / 2, values[-1:])


def changes_to_next(means: np.ndarray) -> np.ndarray:
    """Return the changes (n,) over the time to the next sample of values with these `means` (n,) over it."""
    return np.gradient(means) if len(means) > 1 else np.zeros_like(means)


def thinning_factor(dt: float, rate: float, where: str) -> int:
    """Return the samples of sample time `dt` [s] per sample at `rate` [Hz]; raises `BadInput` if not whole."""
    factor = max(round(1 / (dt * rate)), 1)
    if abs(factor * dt * rate - 1) > UNIFORM:
        nearest = f"{1 / dt:.4g}" if factor == 1 else f"{1 / (dt * factor):.4g}"
        raise BadInput(f"{where}: its {1 / dt:.4g} Hz cannot be thinned to 'rate' {rate:g} Hz; choose {nearest}.")
    return factor


def unwrap(angle: np.ndarray) -> np.ndarray:
    """Return `angle` [rad] without jumps of 2 pi; missing values stay missing."""
    there = np.isfinite(angle)
    smooth = angle.copy()
    smooth[there] = np.unwrap(angle[there])
    return smooth


def fill_gaps(values: np.ndarray) -> np.ndarray:
    """Fill gaps in `values` (n,) linearly; zeros where nothing was measured."""
    good = np.isfinite(values)
    at = np.arange(len(values))
    return np.interp(at, at[good], values[good]) if good.any() else np.zeros_like(values)
