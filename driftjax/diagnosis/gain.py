"""Measure open-loop prediction errors on held-out runs: the gain of naming the causes."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, PyTree

from driftjax.core import State, features
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.observer import Path, samples_in_run
from driftjax.diagnosis.runs import (
    LANES,
    batches,
    concatenate_trees,
    error_blocks,
    padded_size,
    run_observer,
    take,
    theta_of_pieces,
)
from driftjax.gp import GP
from driftjax.parallel import call
from driftjax.sim.rollout import move, sensor_reading
from driftjax.sim.step import hold_of
from driftjax.vehicle.effect import Place
from driftjax.vehicle.universal import Universal

SPANS = (1.0, 2.0, 4.0)  # horizons beside one step [sqrt(L/g)]: about 0.5, 1 and 2 s for a full-size car
DECISIVE = 2  # number of the horizon, one step first, at which shares of the error are measured
START_INTERVAL = 1.0  # time between the starts of predictions [sqrt(L/g)]
SETTLED = 0.5  # time after the start of a piece from which its observer has settled [s]
ROOM = 256  # steps that any program of predictions has room for
RESAMPLES = 2000
TINY = 1e-9  # below which an error over that of noise is none
SMALL = 0.1  # share of the nominal car's squared error from which an excess matters


class Predictions(NamedTuple):
    """Open-loop predictions of one model: P pieces of runs, S starts in each, N steps ahead."""

    starts: np.ndarray  # (S,) samples at which they start
    z: Array  # (P, T, 6) augmented states of the model's observer
    readings: np.ndarray  # (P, S, N, 3) sensor readings of V, beta, r
    error: np.ndarray  # (P, S, N, 3) that less the measurement, NaN where there is none or the run is over


class Errors(NamedTuple):
    """Squared open-loop errors: starts x horizons x channels, NaN where a prediction left its run."""

    squares: np.ndarray
    horizons: tuple[float, ...]
    block: np.ndarray  # number of the block of each start
    piece: np.ndarray  # and of its piece of a run

    @property
    def rms(self) -> np.ndarray:
        """Return the root mean square over all starts (horizons, channels)."""
        return root_mean_square(self.squares, 0)


def scan_rows(step: Callable, state: PyTree, num: Array, room: int) -> Array:
    """Apply `step(j, state) -> (state, row)` for j < `num`; return the rows (room, ...), zero from row `num` on.

    One program serves any number of steps up to `room`, which depends on the size of the car and the sample rate.
    """
    row = jax.eval_shape(step, 0, state)[1]

    def on(j, carry):
        state, rows = carry
        state, row = step(j, state)
        return state, rows.at[j].set(row)

    return jax.lax.fori_loop(0, num, on, (state, jnp.zeros((room, *row.shape))))[1]


def predict_ahead(
    model: Universal, theta: Float[Array, "L K"], z: Float[Array, "L 6"], u: Float[Array, "L n 4"], place: Place,
    num: Array, dt: float, residual: GP | None,
) -> Float[Array, "L n 2 3"]:  # fmt: skip
    """Return V, beta, r 1..num steps after the states `z`, under inputs `u` at the places `place` (L, n), SI.

    They are those of the car, and those that sensors read. A `residual` is added to the rates.
    """
    step = jnp.asarray(dt)

    def one(theta, z, u, place):
        car = model.with_parameters(theta)
        at = features(State(*z[:3]), hold_of(u).mean)
        push = None if residual is None else State(*residual.bounded_mean(at))
        after = move(car, z, u, place, step, push)
        return after.z, jnp.stack([after.z[:3], sensor_reading(car, after.z[:3], after.rates, step)])

    def on(j, z):
        return jax.vmap(one)(theta, z, u[:, j], jax.tree.map(lambda a: a[:, j], place))

    return jnp.moveaxis(scan_rows(on, z, num, u.shape[1]), 0, 1)


def predict_path(
    problem: Problem, theta: np.ndarray, path: Path, starts: np.ndarray, num: int, residual: GP | None = None
) -> np.ndarray:
    """Apply `predict_ahead` at the samples `starts` (S,) of every piece of `path`; return (P, S, num, 2, 3).

    `theta` is as in `predict`. Zero where a run is over at the start.
    """
    data, room = problem.data, padded_size(num, ROOM)
    there = samples_in_run(np.asarray(data.padded.valid))[:, starts]
    piece, start = np.nonzero(there)
    at = np.minimum(starts[start][:, None] + np.arange(room), data.size - 1)
    theta, z, u, place = theta_of_pieces(data, theta), *jax.tree.map(np.asarray, (path.z, path.u, data.padded.place))
    parts = []
    for lane in batches(len(piece), LANES):
        p, rows = piece[lane], at[lane]
        inputs = theta[p], z[p, rows[:, 0]], u[p[:, None], rows], take(place, (p[:, None], rows))
        parts.append(call(predict_ahead, problem.model, *jax.tree.map(jnp.asarray, inputs), jnp.asarray(num), data.dt,
                          residual))  # fmt: skip
    predicted = np.zeros((*there.shape, num, 2, 3))
    if parts:
        predicted[piece, start] = concatenate_trees(parts, len(piece))[:, :num]
    return predicted


def horizon_steps(problem: Problem) -> np.ndarray:
    """Return the horizons in samples: one, and those that the car's size sets."""
    unit = float(problem.model.base.unit_time) / problem.data.dt
    return np.array([1, *(max(round(span * unit), 1) for span in SPANS)])


def prediction_starts(problem: Problem, last: int = len(SPANS)) -> tuple[np.ndarray, int]:
    """Return the samples at which predictions start, and the number of steps to the horizon number `last`."""
    dt, steps = problem.data.dt, horizon_steps(problem)
    every = max(round(START_INTERVAL * float(problem.model.base.unit_time) / dt), 1)
    return np.arange(max(round(SETTLED / dt), problem.data.skip), problem.data.size - 1, every), int(steps[last])


def predict(problem: Problem, theta: np.ndarray, residual: GP | None = None, last: int = len(SPANS)) -> Predictions:
    """Predict with the model `theta` and a `residual` rate, from the states of its own observer.

    `theta` is the same (K,) for all pieces of runs, or one for each (P, K). `last` is the number of the last horizon.
    """
    data, (starts, num) = problem.data, prediction_starts(problem, last)
    path = run_observer(problem.model, data, theta, problem.gains)
    predicted = predict_path(problem, theta, path, starts, num, residual)[:, :, :, 1]
    at = starts[:, None] + np.arange(1, num + 1)
    row = np.minimum(at, data.size - 1)
    valid = (np.asarray(path.valid)[:, row] > 0) & (at < data.size)[..., None] & data.informative[-1]
    off = predicted - np.asarray(path.y)[:, row]
    off[..., 1] = np.angle(np.exp(1j * off[..., 1]))  # a prediction may spin round
    return Predictions(starts, path.z, predicted, np.where(valid, off, np.nan))


def at_horizons(problem: Problem, squares: np.ndarray) -> Errors:
    """Select the squared errors (P, S, N, 3) after one step and at the horizons up to N steps."""
    steps = horizon_steps(problem)
    steps = steps[steps <= squares.shape[2]]
    chosen = squares[:, :, steps - 1]
    starts = prediction_starts(problem)[0]
    piece = np.repeat(np.arange(len(squares)), len(starts))
    horizons = tuple(float(f"{k * problem.data.dt:.6g}") for k in steps)
    return Errors(chosen.reshape(-1, *chosen.shape[2:]), horizons, error_blocks(problem.data)[:, starts].ravel(), piece)


def open_loop_errors(problem: Problem, theta: np.ndarray) -> Errors:
    """Return the errors of the model `theta` after one step and at the horizons."""
    return at_horizons(problem, predict(problem, theta).error ** 2)


def root_mean_square(squares: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    """Return the root mean square from `squares` over `axis`, ignoring NaN; NaN where all are."""
    num = np.isfinite(squares).sum(axis)
    return np.sqrt(np.divide(np.nansum(squares, axis), num, out=np.full(num.shape, np.nan), where=num > 0))


class Share(NamedTuple):
    """Share of the excess error that one model removes, and the share that is left."""

    value: float  # share removed of the excess error of the nominal car; NaN where an excess is in doubt
    ci95: tuple[float, float]
    remaining: float  # share of the model's own squared error that is excess
    remaining_ci95: tuple[float, float]


def excess_shares(errors: dict[str, Errors], least: Errors, seed: int = 0, at: int = DECISIVE) -> dict[str, Share]:
    """Return the `Share` of every model at the horizon number `at`; `nominal` is one of them.

    The error of a right model is `least`, or that of the best of these models where it is smaller, so that an
    overestimated noise floor cannot hide what a model explains. Whether there is an excess is in doubt unless the
    nominal car is surely worse than the best of them in each channel, on the same starts, and by more than `SMALL`.
    Intervals are over blocks of time. Empty where no run lasts that long.
    """
    mean = _resampled_squares(errors, least, seed, at)
    if mean is None:
        return {}
    names, nominal = list(errors), list(errors).index("nominal")
    all_models = np.insert(mean, len(names), 1.0, axis=1)  # `least` among them
    excess = mean.sum(axis=2) - all_models.min(axis=1).sum(axis=1, keepdims=True)
    best = np.take_along_axis(all_models, all_models[:1].argmin(axis=1)[:, None], axis=1).sum(axis=(1, 2))
    worse = 1 - best / np.maximum(mean[:, nominal].sum(axis=1), TINY)
    doubtful = worse[0] < SMALL or np.percentile(worse[1:], 2.5) <= 0
    interval = lambda values: (float(values[0]), tuple(np.percentile(values[1:], [2.5, 97.5]).tolist()))
    removed = 1 - excess / np.maximum(excess[:, [nominal]], TINY)
    remaining = excess / np.maximum(mean.sum(axis=2), TINY)
    unknown = np.nan, (np.nan, np.nan)
    return {
        name: Share(*(unknown if doubtful else interval(removed[:, i])), *interval(remaining[:, i]))
        for i, name in enumerate(names)
    }


def _resampled_squares(errors: dict[str, Errors], least: Errors, seed: int, at: int) -> np.ndarray | None:
    """Return mean squared errors (1 + draws, models, channels) of the data, and of draws of their blocks of time.

    They are scaled by the mean of `least` over their piece of a run, since on a drift some starts spin and others do
    not. None where no run lasts as long as the horizon.
    """
    squares = np.stack([one.squares[:, at] for one in (least, *errors.values())])
    squares = squares[..., np.isfinite(squares).any(axis=1).all(axis=0)]  # channels that the log has
    keep = np.isfinite(squares).all(axis=(0, 2))
    if not squares.shape[2] or not keep.any():
        return None
    piece = np.unique(least.piece[keep], return_inverse=True)[1]
    unit = np.stack([np.bincount(piece, column) for column in squares[0][keep].T], axis=1) / np.bincount(piece)[:, None]
    scaled = squares[1:, keep] / unit[piece]
    block = np.unique(least.block[keep], return_inverse=True)[1]
    sums = np.zeros((block.max() + 1, *scaled.shape[::2]))
    np.add.at(sums, block, scaled.transpose(1, 0, 2))
    count = np.bincount(block)
    draws = np.random.default_rng(seed).integers(0, len(count), (RESAMPLES, len(count)))
    rows = np.concatenate([np.arange(len(count))[None], draws])
    return sums[rows].sum(axis=1) / count[rows].sum(axis=1)[:, None, None]


def ratios(before: Errors, after: Errors, seed: int = 0) -> np.ndarray:
    """Return the RMS error of `after` over that of `before` per horizon, with its 95 % interval: (horizons, 3).

    Each channel is scaled by the mean square of `before`. NaN where no run lasts that long.
    """
    ratio = np.full((len(before.horizons), 3), np.nan)
    for at in range(len(ratio)):
        old, new = before.squares[:, at], after.squares[:, at]
        there = np.isfinite(old).any(axis=0)
        old, new = old[:, there], new[:, there]
        keep = np.isfinite(old + new).all(axis=1)
        if not there.any() or not keep.any():
            continue
        unit = old[keep].mean(axis=0)
        old, new = ((one[keep] / unit).sum(axis=1) for one in (old, new))
        ratio[at] = rms_ratio(before.block[keep], old, new, seed)
    return ratio


def channel_ratios(before: Errors, after: Errors, seed: int = 0, at: int = DECISIVE) -> np.ndarray:
    """Return the RMS error of `after` over that of `before` per channel at one horizon, with its 95 % interval: (3, 3).

    NaN where no run lasts that long.
    """
    ratio = np.full((3, 3), np.nan)
    for i in range(3):
        old, new = before.squares[:, at, i], after.squares[:, at, i]
        keep = np.isfinite(old + new)
        if keep.any():
            ratio[i] = rms_ratio(before.block[keep], old[keep], new[keep], seed)
    return ratio


def rms_ratio(block: np.ndarray, old: np.ndarray, new: np.ndarray, seed: int) -> tuple[float, float, float]:
    """Return the root of the sum of squares `new` (n,) over that of `old` (n,), with its 95 % interval over blocks."""
    names = np.unique(block, return_inverse=True)[1]
    before, after = (np.bincount(names, values) for values in (old, new))
    draws = np.random.default_rng(seed).integers(0, len(before), (RESAMPLES, len(before)))
    low, high = np.percentile(np.sqrt(after[draws].sum(axis=1) / before[draws].sum(axis=1)), [2.5, 97.5])
    return float(np.sqrt(new.sum() / old.sum())), float(low), float(high)
