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


def open_loop(task: Problem, theta: np.ndarray) -> Errors:
    """Errors of the model `theta`, each prediction from where its own observer stands."""
    data = task.data
    horizons = (data.dt, *HORIZONS)
    steps = [max(round(h / data.dt), 1) for h in horizons]
    starts = np.arange(round(0.5 / data.dt), PIECE - 1, round(APART / data.dt))
    path = follow(task.model, data, theta, task.gains)
    squares, blocks = [], []
    for i in range(len(data.run)):
        run = jax.tree.map(lambda a: jnp.asarray(a[i]), data.track)  # noqa: B023
        found = _ahead(task.model, jnp.asarray(theta), run, path.z[i], jnp.asarray(starts), steps[-1], data.dt)
        at = starts[:, None] + np.array(steps)[None, :]
        inside = np.minimum(at, PIECE - 1)
        seen = (np.asarray(run.seen)[inside] > 0) & (at < PIECE)[..., None]
        error = np.asarray(found)[:, np.array(steps) - 1] - np.asarray(run.y)[inside]
        squares.append(np.where(seen, error**2, np.nan))
        blocks.append(data.block[i][starts])
    return Errors(np.concatenate(squares), horizons, np.concatenate(blocks))


def rmse(errors: Errors, which: np.ndarray | None = None) -> np.ndarray:
    """Root mean square (horizons, channels) over the starts `which`."""
    squares = errors.squares if which is None else errors.squares[which]
    return np.sqrt(np.nanmean(squares, axis=0))


def skill(before: Errors, after: Errors, sigma: np.ndarray, seed: int = 0) -> tuple[float, tuple[float, float]]:
    """Share of the explainable error one second ahead that `after` removes, and its 95 % interval over blocks.

    Explainable is what exceeds the measurement noise `sigma` (3,); channels count by their noise.
    """
    at = before.horizons.index(1.0)
    keep = np.isfinite(before.squares[:, at]).all(axis=1) & np.isfinite(after.squares[:, at]).all(axis=1)
    size = lambda errors: np.sum(errors.squares[keep][:, at] / sigma**2 - 1.0, axis=1)
    old, new, names = size(before), size(after), np.unique(before.block[keep], return_inverse=True)[1]
    total = lambda values: np.bincount(names, values, names.max() + 1)
    old, new = total(old), total(new)
    draws = np.random.default_rng(seed).integers(0, len(old), (RESAMPLES, len(old)))
    share = 1 - new[draws].sum(axis=1) / np.maximum(old[draws].sum(axis=1), 1e-9)
    low, high = np.percentile(share, [2.5, 97.5])
    return float(1 - new.sum() / max(old.sum(), 1e-9)), (float(low), float(high))
