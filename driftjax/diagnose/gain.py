"""What naming the cause gains, on runs that had no part in it: open-loop predictions against the measurement."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.diagnose.fit import Problem
from driftjax.diagnose.observer import Track
from driftjax.diagnose.runs import PIECE, follow
from driftjax.sim.rollout import acting, move, told

HORIZONS = (0.5, 1.0, 2.0)  # beside one step [s]
APART = 0.5  # time between the starts of predictions [s]
RESAMPLES = 2000
CHANNELS = ("V", "beta", "r")


class Ahead(NamedTuple):
    """Open-loop predictions of one model: P pieces of runs, S starts in each, N steps ahead."""

    starts: np.ndarray  # (S,) samples at which they start
    told: np.ndarray  # (P, S, N, 3) what sensors would tell of V, beta, r
    error: np.ndarray  # (P, S, N, 3) that less the measurement, NaN where there is none or the run is over


class Errors(NamedTuple):
    """Squared open-loop errors of one model: starts x horizons x channels, NaN where a prediction left its run."""

    squares: np.ndarray
    horizons: tuple[float, ...]
    block: np.ndarray  # number of the block of each start


@eqx.filter_jit
def _ahead(model, theta: Array, run: Track, z: Array, starts: Array, num: int, dt: float) -> Array:
    """Predictions (starts, num, 3) of what sensors tell 1..num steps after samples `starts` at states `z` (T, 6)."""
    model = eqx.tree_at(lambda m: m.theta, model, theta)
    u = acting(model, run.commands, run.V, dt)[-len(run.y) :]
    step = jnp.asarray(dt)

    def one(k):
        def on(z, j):
            row = jnp.minimum(k + j, len(run.y) - 1)
            after = move(model, z, u[row], jax.tree.map(lambda a: a[row], run.place), step)
            return after, told(model, after[:3], (after[:3] - z[:3]) / step)

        return jax.lax.scan(on, z[k], jnp.arange(num))[1]

    return jax.vmap(one)(starts)


def predict(task: Problem, theta: np.ndarray) -> Ahead:
    """Predictions of the model `theta`, each from where its own observer stands, over the longest horizon."""
    data, num = task.data, max(round(HORIZONS[-1] / task.data.dt), 1)
    starts = np.arange(round(0.5 / data.dt), PIECE - 1, round(APART / data.dt))
    at = starts[:, None] + 1 + np.arange(num)
    row = np.minimum(at, PIECE - 1)
    path = follow(task.model, data, theta, task.gains)
    told, errors = [], []
    for i in range(len(data.run)):
        run = jax.tree.map(lambda a: jnp.asarray(a[i]), data.track)  # noqa: B023
        found = np.asarray(_ahead(task.model, jnp.asarray(theta), run, path.z[i], jnp.asarray(starts), num, data.dt))
        seen = (np.asarray(run.seen)[row] > 0) & (at < PIECE)[..., None]
        off = found - np.asarray(run.y)[row]
        off[..., 1] = np.angle(np.exp(1j * off[..., 1]))  # a prediction may spin round
        told.append(found)
        errors.append(np.where(seen, off, np.nan))
    return Ahead(starts, np.stack(told), np.stack(errors))


def errors_of(task: Problem, ahead: Ahead) -> Errors:
    """Errors of `ahead` after one step and the horizons."""
    horizons = (task.data.dt, *HORIZONS)
    steps = np.array([max(round(h / task.data.dt), 1) for h in horizons])
    squares = ahead.error[:, :, steps - 1] ** 2
    return Errors(squares.reshape(-1, *squares.shape[2:]), horizons, task.data.block[:, ahead.starts].ravel())


def open_loop(task: Problem, theta: np.ndarray) -> Errors:
    """Errors of the model `theta` after one step and the horizons."""
    return errors_of(task, predict(task, theta))


def root_mean(squares: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    """Root of the mean of `squares` over `axis`, of those that are not NaN; NaN where all are."""
    num = np.isfinite(squares).sum(axis)
    return np.sqrt(np.divide(np.nansum(squares, axis), num, out=np.full(num.shape, np.nan), where=num > 0))


def rmse(errors: Errors, which: np.ndarray | None = None) -> np.ndarray:
    """Root mean square (horizons, channels) over the starts `which`."""
    return root_mean(errors.squares if which is None else errors.squares[which], 0)


def skill(before: Errors, after: Errors, sigma: np.ndarray, seed: int = 0) -> tuple[float, tuple[float, float]]:
    """Share of the explainable error one second ahead that `after` removes, and its 95 % interval over blocks.

    Explainable is what exceeds the measurement noise `sigma` (3,); channels count by their noise. NaN where no run
    lasts that long.
    """
    at = before.horizons.index(1.0)
    keep = np.isfinite(before.squares[:, at]).all(axis=1) & np.isfinite(after.squares[:, at]).all(axis=1)
    if not keep.any():
        return np.nan, (np.nan, np.nan)
    size = lambda errors: np.sum(errors.squares[keep][:, at] / sigma**2 - 1.0, axis=1)
    old, new, names = size(before), size(after), np.unique(before.block[keep], return_inverse=True)[1]
    total = lambda values: np.bincount(names, values, names.max() + 1)
    old, new = total(old), total(new)
    draws = np.random.default_rng(seed).integers(0, len(old), (RESAMPLES, len(old)))
    share = 1 - new[draws].sum(axis=1) / np.maximum(old[draws].sum(axis=1), 1e-9)
    low, high = np.percentile(share, [2.5, 97.5])
    return float(1 - new.sum() / max(old.sum(), 1e-9)), (float(low), float(high))
