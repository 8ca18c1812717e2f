"""Compute figures of a lap, and their means over plants with confidence intervals."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from driftjax.control.table import ReferenceTable
from driftjax.core.intervals import FEWEST, half_width
from driftjax.sim import LapCode, Trace

DRIFT_BETA = np.deg2rad(20.0)  # sideslip from which a car counts as drifting


class LapFigures(NamedTuple):
    """Figures of one lap over the planned drift section; from true values, except for the measured error."""

    lateral_error: Array  # mean |e| against the planned path [m]
    lateral_error_max: Array  # [m]
    velocity_rmse: Array  # against the reference speed; NaN of a lap that did not reach the section [m/s]
    drift_share: Array  # share with |beta| >= 20 deg, opposite in sign to the turn [-]
    completed: Array  # bool
    lateral_error_measured: Array  # mean |e| by the measured e and s: what the learner judges its laps by [m]


class _Section(NamedTuple):
    """The part of the planned drift section that one lap covered."""

    inside: Bool[Array, " T"]
    ds: Float[Array, " T"]  # distance that each row stands for, 0 outside [m]
    driven: Array  # [m]
    missing: Array  # [m]

    def mean(self, values: Float[Array, " T"]) -> Array:
        """Return the mean over the distance driven; 0 where there is none."""
        total = jnp.sum(jnp.where(self.inside, values, 0.0) * self.ds)
        return total / jnp.maximum(jnp.sum(self.ds), 1e-9)

    def lateral_error(self, e: Float[Array, " T"], lost_error: ArrayLike) -> Array:
        """Return the mean of |e|; the missing part counts with `lost_error` [m]."""
        return (self.mean(jnp.abs(e)) * self.driven + lost_error * self.missing) / (self.driven + self.missing)


def _section(s: Float[Array, " T"], alive: Bool[Array, " T"], completed: Array, table: ReferenceTable) -> _Section:
    inside = (s >= table.drift_start) & (s <= table.drift_end) & alive
    ds = jnp.diff(s, append=s[-1:])
    ds = jnp.where(inside & jnp.isfinite(ds), jnp.maximum(ds, 0.0), 0.0)  # a lap may end in numbers that are not
    length = table.drift_end - table.drift_start
    driven = jnp.minimum(jnp.sum(ds), length)
    return _Section(inside, ds, driven, jnp.where(completed, 0.0, length - driven))


def lap_figures(trace: Trace, code: Array, table: ReferenceTable, V_ref: Array, lost_error: ArrayLike) -> LapFigures:
    """Compute the figures of one lap (time on the leading axis).

    Means are over distance. The part of the section that a failed lap missed counts with the error `lost_error` [m], so
    that failing early is never an advantage; a speed that was never driven has no error, which is NaN and not 0. The
    measured arc length is made monotone: noise must not add distance.
    """
    completed = code == int(LapCode.COMPLETED)
    true = _section(trace.s, trace.alive, completed, table)
    measured = _section(jax.lax.cummax(trace.sensed.s), trace.alive, completed, table)
    worst = jnp.max(jnp.where(true.inside, jnp.abs(trace.e), 0.0))
    middle = jnp.sum(jnp.where(true.inside, trace.r, 0.0))
    sideways = (jnp.abs(trace.beta) >= DRIFT_BETA) & (trace.beta * jnp.sign(middle) < 0)
    return LapFigures(
        lateral_error=true.lateral_error(trace.e, lost_error),
        lateral_error_max=jnp.where(true.missing > 0, jnp.maximum(worst, lost_error), worst),
        velocity_rmse=jnp.where(true.driven > 0, jnp.sqrt(true.mean((trace.V - V_ref) ** 2)), jnp.nan),
        drift_share=true.mean(sideways.astype(float)) * true.driven / (true.driven + true.missing),
        completed=completed,
        lateral_error_measured=measured.lateral_error(trace.sensed.e, lost_error),
    )


def interval(values: np.ndarray) -> dict[str, Any]:
    """Return the mean over plants with its 95 % interval by Student's t; no interval for fewer than `FEWEST` plants.

    Values that are not finite are left out: `plants` says how many enter, `all_plants` how many there are. Simulated
    coverage over 3 to 16 plants: 0.95 of normal values, 0.92 to 0.94 of lognormal ones whose logarithms deviate by
    0.5, but 0.82 to 0.90 where they deviate by 1. The bootstrap BCa covers less of the first two: 0.89 and 0.88 over
    10 plants, 0.93 and 0.90 over 16.
    """
    values = np.asarray(values, float)
    kept = values[np.isfinite(values)]
    count = {"plants": len(kept), "all_plants": len(values)}
    mean = float(kept.mean()) if len(kept) else None
    if mean is None or len(kept) < FEWEST:
        return {"mean": mean, "ci95": [None, None]} | count
    half = half_width(kept)
    return {"mean": mean, "ci95": [mean - half, mean + half]} | count


def reduction(before: np.ndarray, after: np.ndarray) -> dict[str, Any]:
    """Return the reduction of the mean from `before` to `after` in percent, with a paired 95 % interval over plants.

    Student's t on the jackknife of the logarithm of the ratio of means (Efron and Tibshirani 1993, chapter 11).
    Plants that lack either value are left out, and fewer than `FEWEST` have no interval, as in `interval`. Simulated
    coverage over 3 to 16 plants: 0.94 to 0.95 of lognormal values whose logarithms deviate by up to 0.5, 0.92 or more
    where they deviate by 1.
    """
    before, after = np.asarray(before, float), np.asarray(after, float)
    both = np.isfinite(before) & np.isfinite(after)
    count = {"plants": int(both.sum()), "all_plants": len(both)}
    before, after = before[both], after[both]
    if not len(before):
        return {"value": None, "ci95": [None, None]} | count
    value = 100 * (1 - after.mean() / before.mean())
    without = lambda values: values.sum() - values  # the sum of all plants but one
    if len(before) < FEWEST or not np.all((without(before) > 0) & (without(after) > 0)):  # no logarithm of no error
        return {"value": float(value), "ci95": [None, None]} | count
    num = len(before)
    pseudo = -(num - 1) * np.log(without(after) / without(before))  # up to a constant, which has no spread
    middle, half = np.log(after.mean() / before.mean()), half_width(pseudo)
    ends = [float(100 * (1 - np.exp(end))) for end in (middle + half, middle - half)]
    return {"value": float(value), "ci95": ends} | count


def difference(before: np.ndarray, after: np.ndarray) -> dict[str, Any]:
    """Return the mean of `after` - `before` over pairs with its 95 % interval, as `interval` makes it."""
    change = interval(np.asarray(after, float) - np.asarray(before, float))
    return {"mean": change["mean"], "ci95": change["ci95"], "pairs": change["plants"]}
