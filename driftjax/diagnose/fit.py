"""Hypotheses fitted: Gauss-Newton on the parameters of the effects in question, through the observer's innovations."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from driftjax.data import Run
from driftjax.diagnose.noise import CORRELATION, FIRST, PRIOR, Noise, estimate, measurement_noise
from driftjax.diagnose.observer import Gains
from driftjax.diagnose.runs import (
    Followed,
    Pieces,
    derivatives,
    differentiate,
    follow,
    gains,
    held,
    pick,
    pieces,
    whiten,
)
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import Effect
from driftjax.vehicle.universal import Universal, universal

LENGTHS = (1.0, 0.5, 0.25, 0.1)  # of Gauss-Newton steps tried
TOLERANCE = 0.1  # fall of the cost below which a fit is done


class Problem(NamedTuple):
    """Data and model of one diagnosis, with the noise and the observer's gains."""

    model: Universal
    data: Pieces
    lower: np.ndarray  # (K,) bounds of theta, in typical sizes
    upper: np.ndarray
    owner: np.ndarray  # (K,) index of the effect that a parameter belongs to
    has: frozenset[str]  # further columns that every run has
    asked: np.ndarray  # (K,) whether the parameter is in question: others stay at 0
    noise: Noise
    gains: Gains

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The catalogue, in the order of `owner`."""
        return self.model.effects

    def columns(self, members: tuple[int, ...]) -> np.ndarray:
        """Parameters of the effects `members`."""
        return np.flatnonzero(np.isin(self.owner, members))

    def part(self, runs: np.ndarray) -> "Problem":
        """The same problem over the runs with these numbers only."""
        keep = np.flatnonzero(np.isin(self.data.run, runs))
        return self._replace(data=self.data.part(keep), gains=pick(self.gains, keep))


class Fit(NamedTuple):
    """One hypothesis at its best."""

    theta: np.ndarray  # (K,) in typical sizes
    cost: float  # sum of squares of whitened innovations, prior included


def problem(
    vehicle: VehicleConfig, effects: tuple[Effect, ...], runs: tuple[Run, ...], without: tuple[str, ...] = ()
) -> Problem:
    """Everything that questions need, the noise estimated from the data.

    Effects `without` which the question is put stay neutral, as do those whose columns a run lacks.
    """
    model, data = universal(vehicle, effects), pieces(vehicle, runs)
    seen = jnp.asarray(data.track.seen)
    sigma = measurement_noise(np.asarray(data.track.y), np.asarray(data.track.seen))
    start = Noise(sigma, FIRST * sigma, CORRELATION)
    theta = np.zeros(len(model.theta))
    fixed, has = held(data), frozenset.intersection(*(frozenset(run.extra) for run in runs))
    parameters = [(i, p) for i, effect in enumerate(effects) for p in effect.parameters]
    asked = np.array([effects[i].name not in without and set(effects[i].needs) <= has for i, _ in parameters])
    path = follow(model, data, theta, fixed)
    noise = estimate(derivatives(model, data, theta, path, asked), path.e, fixed, seen, start, data.dt)
    lower, upper = (np.array([getattr(p, side) for _, p in parameters], float) for side in ("lower", "upper"))
    owner = np.array([i for i, _ in parameters])
    return Problem(model, data, lower, upper, owner, has, asked, noise, gains(model, data, noise.row(), fixed))


def around(task: Problem, fit: Fit) -> Followed:
    """Whitened innovations and their derivatives at `fit`."""
    return differentiate(task.model, task.data, fit.theta, task.gains, task.asked)


def priced(task: Problem, theta: np.ndarray) -> Fit:
    """The hypothesis `theta` with its cost, infinite where the observer loses the car."""
    e = whiten(task.gains, follow(task.model, task.data, theta, task.gains).e)
    cost = float(jnp.sum(e**2)) + float(np.sum(theta**2)) / PRIOR**2
    return Fit(theta, cost if np.isfinite(cost) else np.inf)


def information(J: ArrayLike) -> np.ndarray:
    """Information (K, K) of derivatives (P, T, 3, K)."""
    J = np.asarray(J)
    return np.einsum("ptij,ptik->jk", J, J, optimize=True)


def normal(at: Followed) -> tuple[np.ndarray, np.ndarray]:
    """Information (K, K) and score (K,)."""
    return information(at.J), np.einsum("ptij,pti->j", np.asarray(at.J), np.asarray(at.e), optimize=True)


def refine(task: Problem, fit: Fit, columns: np.ndarray, at: Followed | None = None, num: int = 6) -> Fit:
    """`fit` improved over the parameters `columns` by at most `num` Gauss-Newton steps, until its cost hardly falls.

    `at` is the model linearised at `fit`, where that is known already.
    """
    if not len(columns):
        return fit
    for _ in range(num):
        H, b = normal(around(task, fit) if at is None else at)
        at, part = None, H[np.ix_(columns, columns)] + np.eye(len(columns)) / PRIOR**2
        step = np.zeros_like(fit.theta)
        step[columns] = np.linalg.solve(part, b[columns] - fit.theta[columns] / PRIOR**2)
        before, fit = fit.cost, _shorten(task, fit, step)
        if not before - fit.cost > TOLERANCE:
            break
    return fit


def _shorten(task: Problem, fit: Fit, step: np.ndarray) -> Fit:
    """The first of ever shorter steps that lowers the cost, else `fit`."""
    for length in LENGTHS:
        trial = priced(task, np.clip(fit.theta + length * step, task.lower, task.upper))
        if trial.cost < fit.cost:
            return trial
    return fit
