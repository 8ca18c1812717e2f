"""Open-loop prediction errors on held-out runs: what naming the causes gains."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import State, features
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.observer import PaddedRun
from driftjax.diagnosis.runs import error_blocks, map_pieces, run_observer
from driftjax.gp import GP
from driftjax.parallel import call
from driftjax.sim.rollout import acting, move, sensor_reading
from driftjax.sim.step import hold_of
from driftjax.vehicle.universal import Universal

HORIZONS = (0.5, 1.0, 2.0)  # beside one step [s]
SKILL_HORIZON = 1.0  # horizon at which the share of the error removed is measured [s]
START_INTERVAL = 0.5  # time between the starts of predictions [s]
RESAMPLES = 2000


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


def predict_run(
    model: Universal, theta: Array, run: PaddedRun, z: Array, starts: Array, num: int, dt: float,
    residual: GP | None,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the predicted V, beta, r 1..num steps after samples `starts` at states `z` (T, 6), and what sensors read.

    Both (starts, num, 3), SI. A `residual` is added to the rates.
    """
    model = model.with_parameters(theta)
    u = acting(model, run.commands, run.V, dt)[-len(run.y) :]
    step = jnp.asarray(dt)

    def one(k):
        def on(z, j):
            row = jnp.minimum(k + j, len(run.y) - 1)
            at = features(State(*z[:3]), hold_of(u[row]).mean)
            push = None if residual is None else State(*residual.bounded_mean(at))
            after = move(model, z, u[row], jax.tree.map(lambda a: a[row], run.place), step, push)
            return after.z, (after.z[:3], sensor_reading(model, after.z[:3], after.rates, step))

        return jax.lax.scan(on, z[k], jnp.arange(num))[1]

    return jax.vmap(one)(starts)


def _predict_runs(model, theta, runs, z, starts, num, dt, residual):
    axes = (None, None, 0, 0, None, None, None, None)
    return eqx.filter_vmap(predict_run, in_axes=axes)(model, theta, runs, z, starts, num, dt, residual)


def predict_pieces(*args) -> tuple[Array, Array]:
    """Apply `predict_run` to a batch of pieces with their states `z` (P, T, 6)."""
    return call(_predict_runs, *args)


def prediction_starts(problem: Problem) -> tuple[np.ndarray, int]:
    """Return the samples at which predictions start, and the number of steps."""
    dt, size = problem.data.dt, problem.data.size
    return np.arange(round(0.5 / dt), size - 1, round(START_INTERVAL / dt)), max(round(HORIZONS[-1] / dt), 1)


def predict(problem: Problem, theta: np.ndarray, residual: GP | None = None) -> Predictions:
    """Predict with the model `theta` and a `residual` rate, from the states of its own observer."""
    data, (starts, num) = problem.data, prediction_starts(problem)
    where, first = jnp.asarray(theta), jnp.asarray(starts)
    path = run_observer(problem.model, data, theta, problem.gains)
    one = lambda run, z: predict_pieces(problem.model, where, run, z, first, num, data.dt, residual)
    told = np.asarray(map_pieces(one, len(data.run), data.padded, path.z)[1])
    at = starts[:, None] + np.arange(1, num + 1)
    row = np.minimum(at, data.size - 1)
    valid = (np.asarray(path.valid)[:, row] > 0) & (at < data.size)[..., None]
    off = told - np.asarray(path.y)[:, row]
    off[..., 1] = np.angle(np.exp(1j * off[..., 1]))  # a prediction may spin round
    return Predictions(starts, path.z, told, np.where(valid, off, np.nan))


def at_horizons(problem: Problem, squares: np.ndarray) -> Errors:
    """Select the squared errors (P, S, N, 3) after one step and at the horizons."""
    horizons = (problem.data.dt, *HORIZONS)
    steps = np.array([max(round(h / problem.data.dt), 1) for h in horizons])
    chosen = squares[:, :, steps - 1]
    starts = prediction_starts(problem)[0]
    piece = np.repeat(np.arange(len(squares)), len(starts))
    return Errors(chosen.reshape(-1, *chosen.shape[2:]), horizons, error_blocks(problem.data)[:, starts].ravel(), piece)


def open_loop_errors(problem: Problem, theta: np.ndarray) -> Errors:
    """Return the errors of the model `theta` after one step and at the horizons."""
    return at_horizons(problem, predict(problem, theta).error ** 2)


def root_mean_square(squares: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    """Return the root mean square from `squares` over `axis`, ignoring NaN; NaN where all are."""
    num = np.isfinite(squares).sum(axis)
    return np.sqrt(np.divide(np.nansum(squares, axis), num, out=np.full(num.shape, np.nan), where=num > 0))


def skill(before: Errors, after: Errors, least: Errors, seed: int = 0) -> tuple[float, tuple[float, float]]:
    """Return the share of the explainable error one second ahead that `after` removes, with its 95 % interval.

    Explainable is what exceeds the `least`, the floor that noise makes; errors count in its mean over their piece of a
    run, for on a drift some starts spin and others do not. NaN where no run lasts that long, or where the data leave it
    in doubt that anything is explainable: no share of that has a meaning.
    """
    at = before.horizons.index(SKILL_HORIZON)
    cut = [errors.squares[:, at] for errors in (before, after, least)]
    keep = np.all([np.isfinite(squares).all(axis=1) for squares in cut], axis=0)
    if not keep.any():
        return np.nan, (np.nan, np.nan)
    piece = np.unique(before.piece[keep], return_inverse=True)[1]
    unit = np.stack([np.bincount(piece, column) for column in cut[2][keep].T], axis=1) / np.bincount(piece)[:, None]
    old, new = (np.sum((squares - cut[2])[keep] / unit[piece], axis=1) for squares in cut[:2])
    whole, rest = resample_blocks(before.block[keep], old, new, seed)
    if np.percentile(whole, 2.5) <= 0:
        return np.nan, (np.nan, np.nan)
    low, high = np.percentile(1 - rest / np.maximum(whole, 1e-9), [2.5, 97.5])
    return float(1 - new.sum() / old.sum()), (float(low), float(high))


def ratios(before: Errors, after: Errors, seed: int = 0) -> np.ndarray:
    """Return the RMS error of `after` over that of `before` per horizon, with its 95 % interval: (horizons, 3).

    Channels count in the mean square of `before`, alike. NaN where no run lasts that long.
    """
    found = np.full((len(before.horizons), 3), np.nan)
    for at in range(len(found)):
        old, new = before.squares[:, at], after.squares[:, at]
        keep = np.isfinite(old + new).all(axis=1)
        if not keep.any():
            continue
        unit = old[keep].mean(axis=0)
        old, new = ((one[keep] / unit).sum(axis=1) for one in (old, new))
        whole, rest = resample_blocks(before.block[keep], old, new, seed)
        found[at] = np.sqrt(new.sum() / old.sum()), *np.percentile(np.sqrt(rest / whole), [2.5, 97.5])
    return found


def resample_blocks(block: np.ndarray, old: np.ndarray, new: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return bootstrap sums (RESAMPLES,) of `old` and `new` (n,) over blocks, the same draws for both."""
    names = np.unique(block, return_inverse=True)[1]
    old, new = (np.bincount(names, values) for values in (old, new))
    draws = np.random.default_rng(seed).integers(0, len(old), (RESAMPLES, len(old)))
    return old[draws].sum(axis=1), new[draws].sum(axis=1)
