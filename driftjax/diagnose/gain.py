"""What naming the cause gains, on runs that had no part in it: open-loop predictions against the measurement."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import Control, State, features
from driftjax.diagnose.fit import Problem
from driftjax.diagnose.observer import Track, expected
from driftjax.diagnose.runs import PIECE, each_piece, follow, transitions
from driftjax.gp import GP
from driftjax.sim.rollout import acting, move, told
from driftjax.vehicle.universal import Universal

HORIZONS = (0.5, 1.0, 2.0)  # beside one step [s]
SKILL = 1.0  # horizon at which the share of the error removed is measured [s]
APART = 0.5  # time between the starts of predictions [s]
RESAMPLES = 2000


class Errors(NamedTuple):
    """Squared open-loop errors: starts x horizons x channels, NaN where a prediction left its run."""

    squares: np.ndarray
    horizons: tuple[float, ...]
    block: np.ndarray  # number of the block of each start

    @property
    def rms(self) -> np.ndarray:
        """Root of the mean over all starts (horizons, channels)."""
        return np.sqrt(np.nanmean(self.squares, axis=0))


@eqx.filter_jit
def ahead(
    model: Universal, theta: Array, run: Track, z: Array, starts: Array, num: int, dt: float, residual: GP | None = None
) -> Array:
    """Predictions (starts, num, 3) of what sensors tell 1..num steps after samples `starts` at states `z` (T, 6).

    A `residual` is added to the rates.
    """
    model = model.at(theta)
    u = acting(model, run.commands, run.V, dt)[-len(run.y) :]
    step = jnp.asarray(dt)

    def one(k):
        def on(z, j):
            row = jnp.minimum(k + j, len(run.y) - 1)
            at = features(State(*z[:3]), Control(*u[row]))
            push = None if residual is None else State(*residual.bounded_mean(at))
            after = move(model, z, u[row], jax.tree.map(lambda a: a[row], run.place), step, push)
            return after, told(model, after[:3], (after[:3] - z[:3]) / step)

        return jax.lax.scan(on, z[k], jnp.arange(num))[1]

    return jax.vmap(one)(starts)


_expected = eqx.filter_jit(expected)


def plan(task: Problem) -> tuple[tuple[float, ...], list[int], np.ndarray]:
    """Horizons [s], the same in steps, and the samples that predictions start from."""
    dt = task.data.dt
    horizons = (dt, *HORIZONS)
    starts = np.arange(round(0.5 / dt), PIECE - 1, round(APART / dt))
    return horizons, [max(round(h / dt), 1) for h in horizons], starts


def gathered(task: Problem, squares: np.ndarray) -> Errors:
    """`squares` (P, starts, steps, 3) at the horizons, where they were measured."""
    horizons, steps, starts = plan(task)
    at = starts[:, None] + np.array(steps)[None, :]
    inside = np.minimum(at, PIECE - 1)
    seen = (np.asarray(task.data.track.seen)[:, inside] > 0) & (at < PIECE)[..., None]
    chosen = np.where(seen, squares[:, :, np.array(steps) - 1], np.nan)
    return Errors(chosen.reshape(-1, len(steps), 3), horizons, task.data.block[:, starts].reshape(-1))


def open_loop(task: Problem, theta: np.ndarray, residual: GP | None = None) -> Errors:
    """Errors of the model `theta` with a `residual` rate, each prediction from where its own observer stands."""
    data, (_, steps, starts) = task.data, plan(task)
    where, first = jnp.asarray(theta), jnp.asarray(starts)
    one = lambda run, z: ahead(task.model, where, run, z, first, steps[-1], data.dt, residual)
    path = follow(task.model, data, theta, task.gains)
    found = np.asarray(each_piece(one, len(data.run), data.track, path.z))
    after = np.minimum(starts[:, None] + np.arange(1, steps[-1] + 1), PIECE - 1)
    return gathered(task, (found - np.asarray(data.track.y)[:, after]) ** 2)


def floor(task: Problem, theta: np.ndarray) -> Errors:
    """Errors that measurement and process noise would make of a true model, near `theta`, to first order."""
    data, (_, steps, starts) = task.data, plan(task)
    where = jnp.asarray(theta)
    A = transitions(task.model, data, where, follow(task.model, data, theta, task.gains))
    noise = jnp.asarray(task.noise.row())
    one = lambda A, P: _expected(A, P, noise, jnp.asarray(starts), steps[-1], data.dt)
    return gathered(task, np.asarray(each_piece(one, len(data.run), A, task.gains.P)))


def skill(before: Errors, after: Errors, least: Errors, seed: int = 0) -> tuple[float, tuple[float, float]]:
    """Share of the explainable error one second ahead that `after` removes, and its 95 % interval over blocks.

    Explainable is what exceeds the `least`, the floor that noise makes; errors count in units of it.
    """
    at = before.horizons.index(SKILL)
    cut = [errors.squares[:, at] for errors in (before, after, least)]
    keep = np.all([np.isfinite(squares).all(axis=1) for squares in cut], axis=0)
    old, new = (np.sum(squares[keep] / cut[2][keep] - 1.0, axis=1) for squares in cut[:2])
    names = np.unique(before.block[keep], return_inverse=True)[1]
    old, new = (np.bincount(names, values) for values in (old, new))
    draws = np.random.default_rng(seed).integers(0, len(old), (RESAMPLES, len(old)))
    share = 1 - new[draws].sum(axis=1) / np.maximum(old[draws].sum(axis=1), 1e-9)
    low, high = np.percentile(share, [2.5, 97.5])
    return float(1 - new.sum() / max(old.sum(), 1e-9)), (float(low), float(high))
