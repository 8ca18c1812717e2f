"""Figures of a lap, and their means over plants with intervals."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from scipy.special import stdtrit

from driftjax.control.table import ReferenceTable
from driftjax.sim import LapCode, Trace

DRIFT_BETA = np.deg2rad(20.0)  # sideslip from which a car counts as drifting
RESAMPLES = 2000  # of the bootstrap


class LapFigures(NamedTuple):
    """One lap in numbers, over the planned drift section."""

    lateral_error: Array  # mean |e| against the planned path [m]
    lateral_error_max: Array  # [m]
    velocity_rmse: Array  # against the reference speed [m/s]
    drift_share: Array  # share with |beta| >= 20 deg, opposite in sign to the turn [-]
    completed: Array  # bool


def lap_figures(trace: Trace, code: Array, table: ReferenceTable, V_ref: Array, lost_error: ArrayLike) -> LapFigures:
    """Figures of one lap (time on the leading axis), from true values.

    Means are over distance. What a failed lap did not drive of the section counts with the error `lost_error` [m],
    so that failing early never looks good.
    """
    inside = (trace.s >= table.drift_start) & (trace.s <= table.drift_end) & trace.alive
    ds = jnp.diff(trace.s, append=trace.s[-1:])
    ds = jnp.where(inside & jnp.isfinite(ds), jnp.maximum(ds, 0.0), 0.0)  # a lap may end in numbers that are not
    length = table.drift_end - table.drift_start
    driven = jnp.minimum(jnp.sum(ds), length)
    completed = code == int(LapCode.COMPLETED)
    missing = jnp.where(completed, 0.0, length - driven)
    mean = lambda values: jnp.sum(jnp.where(inside, values, 0.0) * ds) / jnp.maximum(jnp.sum(ds), 1e-9)
    error = jnp.abs(trace.e)
    weighted = (mean(error) * driven + lost_error * missing) / (driven + missing)
    worst = jnp.max(jnp.where(inside, error, 0.0))
    middle = jnp.sum(jnp.where(inside, trace.r, 0.0))
    sideways = (jnp.abs(trace.beta) >= DRIFT_BETA) & (trace.beta * jnp.sign(middle) < 0)
    share = mean(sideways.astype(float)) * driven / (driven + missing)
    rmse = jnp.sqrt(mean((trace.V - V_ref) ** 2))
    return LapFigures(weighted, jnp.where(missing > 0, jnp.maximum(worst, lost_error), worst), rmse, share, completed)


def interval(values: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """Mean over plants with its 95 % bootstrap interval (percentiles over resampled plants); none of a single plant."""
    values = np.asarray(values, float)
    if len(values) < 2:
        return {"mean": float(values.mean()), "ci95": [None, None]}
    draws = np.random.default_rng(seed).integers(0, len(values), (RESAMPLES, len(values)))
    low, high = np.percentile(values[draws].mean(axis=1), [2.5, 97.5])
    return {"mean": float(values.mean()), "ci95": [float(low), float(high)]}


def reduction(before: np.ndarray, after: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """By how many percent the mean falls from `before` to `after`, with a paired bootstrap interval over plants."""
    before, after = np.asarray(before, float), np.asarray(after, float)
    share = lambda b, a: 100 * (1 - a.mean(axis=-1) / b.mean(axis=-1))
    if len(before) < 2:
        return {"value": float(share(before, after)), "ci95": [None, None]}
    draws = np.random.default_rng(seed).integers(0, len(before), (RESAMPLES, len(before)))
    low, high = np.percentile(share(before[draws], after[draws]), [2.5, 97.5])
    return {"value": float(share(before, after)), "ci95": [float(low), float(high)]}


def difference(before: np.ndarray, after: np.ndarray) -> dict[str, Any]:
    """Mean of `after` less `before` over pairs, with its 95 % interval by Student's t; none of a single pair."""
    apart = np.asarray(after, float) - np.asarray(before, float)
    num = len(apart)
    if num < 2:
        return {"mean": float(apart.mean()) if num else None, "ci95": [None, None], "pairs": num}
    half = float(stdtrit(num - 1, 0.975)) * apart.std(ddof=1) / np.sqrt(num)
    return {"mean": float(apart.mean()), "ci95": [float(apart.mean() - half), float(apart.mean() + half)], "pairs": num}
