"""What figures of a diagnosis need, as one dataset: `diagnosis.nc`."""

import numpy as np
import xarray as xr

from driftjax.diagnosis.binned import BINS
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import APART, root_mean
from driftjax.diagnosis.held_out import Gain
from driftjax.diagnosis.residual import FORCES
from driftjax.diagnosis.select import Selection
from driftjax.diagnosis.show import Show
from driftjax.diagnosis.smooth import inside
from driftjax.logs.columns import MEASURED
from driftjax.store import DIAGNOSIS, dataset

PANELS = 3  # runs drawn in the fan at most
EVERY = 2.0  # time between the predictions drawn [s]
POINTS = 100  # of a curve over the horizon at most
MODELS = ("nominal", "extended")


def figure_data(car: str, task: Problem, selection: Selection, shown: Show, gain: Gain | None) -> xr.Dataset:
    """Return the dataset of `diagnosis.nc`, in single precision; `car` is the vehicle's name."""
    dt = task.data.dt
    values = curves(shown, dt) | fan(shown, dt) | forces(shown) | scored(task, selection, shown)
    values |= {
        "channel": np.array(MEASURED), "model": np.array(MODELS), "sigma": task.noise.sigma,
        "lag_time": dt * np.arange(1, len(shown.white["nominal"].correlation) + 1),
        "autocorrelation": np.stack([shown.white[name].correlation for name in MODELS]),
    }  # fmt: skip
    single = {name: a.astype(np.float32) if a.dtype.kind == "f" else a for name, a in values.items()}
    attrs = {
        "car": car, "predicted_on": "runs held out" if gain else "the runs it was named from",
        "score_threshold": shown.scores.threshold, "white_band": shown.white["nominal"].band,
    }  # fmt: skip
    return dataset(single, attrs, DIAGNOSIS)


def thinned(num: int) -> np.ndarray:
    """At most `POINTS` of the indices below `num`, first and last among them."""
    return np.unique(np.linspace(0, num - 1, POINTS).round().astype(int))


def curves(shown: Show, dt: float) -> dict[str, np.ndarray]:
    """Errors over the horizon."""
    keep = thinned(len(shown.floor))
    rmse = [root_mean(one.error[:, :, keep] ** 2, (0, 1)) for one in shown.judged.ahead.values()]
    return {
        "compared": np.array(list(shown.judged.ahead)), "horizon": dt * (keep + 1), "rmse": np.stack(rmse),
        "floor": shown.floor[keep],
    }  # fmt: skip


def fan(shown: Show, dt: float) -> dict[str, np.ndarray]:
    """Predictions from some starts in the first runs beside what was measured."""
    task, ahead = shown.judged.task, shown.judged.ahead
    first = np.unique(task.data.run, return_index=True)[1][:PANELS]  # the first piece of each run
    names = np.array([shown.names[number] for number in task.data.run[first].tolist()])
    seen, y = (np.asarray(a)[first] for a in (task.data.track.seen, task.data.track.y))
    every = max(round(EVERY / APART), 1)
    starts = ahead["nominal"].starts[::every]
    keep = thinned(shown.floor.shape[0])
    told = np.stack([ahead[name].told[first][:, ::every][:, :, keep] for name in MODELS], axis=1)
    rows = starts[:, None] + 1 + keep
    driven = (rows < y.shape[1]) & inside(seen)[:, np.minimum(rows, y.shape[1] - 1)]
    return {
        "panel": names, "sample_time": dt * np.arange(y.shape[1]), "measured": np.where(seen > 0, y, np.nan),
        "start_time": dt * starts, "ahead_time": dt * (keep + 1),
        "predicted": np.where(driven[:, None, ..., None], told, np.nan),
    }  # fmt: skip


def forces(shown: Show) -> dict[str, np.ndarray]:
    """Residual forces in bins; bins left out are NaN."""
    each = [shown.residual[name] for name in MODELS]
    names = [name for name in each[0].over if all(name in one.over for one in each)]
    pad = lambda a: np.concatenate([a, np.full((BINS - len(a), *a.shape[1:]), np.nan)])
    column = lambda pick: np.array([[pick(one.over[name]) for name in names] for one in each])
    shape = (len(each), len(names), BINS)
    return {
        "force": np.array(FORCES), "force_limit": shown.limits, "driver": np.array(names),
        "bin_value": column(lambda one: pad(one.value)).reshape(shape),
        "bin_mean": column(lambda one: pad(one.mean)).reshape(*shape, 3),
        "bin_error": column(lambda one: pad(one.error)).reshape(*shape, 3),
        "explained": column(lambda one: one.explained).reshape(len(each), len(names), 3),
    }  # fmt: skip


def scored(task: Problem, selection: Selection, shown: Show) -> dict[str, np.ndarray]:
    """Scores at the nominal car, and how alike the parameters' signatures are at the extended one."""
    names = np.array([f"{effect.name}.{p.name}" for effect in task.effects for p in effect.parameters])
    H = selection.scores.H
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    cosine = np.divide(np.abs(H), size[:, None] * size, out=np.full(H.shape, np.nan), where=size[:, None] * size > 0)
    return {
        "effect": np.array([effect.name for effect in task.effects]), "promise": shown.scores.gain,
        "parameter": names, "other": names, "score": shown.scores.T,
        "named": np.isin(task.owner, selection.members), "cosine": np.minimum(cosine, 1.0),
    }  # fmt: skip
