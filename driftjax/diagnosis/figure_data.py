"""Assemble the data of the figures of a diagnosis: `diagnosis.nc`."""

import numpy as np
import xarray as xr

from driftjax.diagnosis.findings import Findings
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.force_bins import BINS
from driftjax.diagnosis.gain import root_mean_square
from driftjax.diagnosis.held_out import PredictionGain
from driftjax.diagnosis.observer import samples_in_run
from driftjax.diagnosis.residual import FORCES
from driftjax.diagnosis.select import Selection
from driftjax.logs.columns import MEASURED
from driftjax.store import DIAGNOSIS, dataset

PANELS = 3  # runs drawn in the fan at most
EVERY = 2.0  # time between the predictions drawn [s]
POINTS = 100  # of a curve over the horizon at most
MODELS = ("nominal", "extended")


def figure_data(
    car: str, problem: Problem, selection: Selection, findings: Findings, gain: PredictionGain | None
) -> xr.Dataset:
    """Return the dataset of `diagnosis.nc`, in single precision; `car` is the vehicle's name."""
    dt = problem.data.dt
    values = (
        horizon_curves(findings, dt)
        | fan(findings, dt)
        | force_bins(findings)
        | score_data(problem, selection, findings)
    )
    values |= {
        "channel": np.array(MEASURED), "model": np.array(MODELS), "sigma": problem.noise.total,
        "lag_time": dt * np.arange(1, len(findings.autocorrelation["nominal"].correlation) + 1),
        "autocorrelation": np.stack([findings.autocorrelation[name].correlation for name in MODELS]),
    }  # fmt: skip
    single = {name: a.astype(np.float32) if a.dtype.kind == "f" else a for name, a in values.items()}
    attrs = {
        "car": car, "predicted_on": "runs held out" if gain else "the runs it was named from",
        "score_threshold": findings.scores.threshold, "white_band": findings.autocorrelation["nominal"].band,
    }  # fmt: skip
    return dataset(single, attrs, DIAGNOSIS)


def thin_indices(num: int) -> np.ndarray:
    """Return at most `POINTS` evenly spaced indices below `num`, first and last included."""
    return np.unique(np.linspace(0, num - 1, POINTS).round().astype(int))


def horizon_curves(findings: Findings, dt: float) -> dict[str, np.ndarray]:
    """Return the prediction errors over the horizon."""
    keep = thin_indices(len(findings.noise_floor))
    rmse = [root_mean_square(one.error[:, :, keep] ** 2, (0, 1)) for one in findings.comparison.predictions.values()]
    return {
        "compared": np.array(list(findings.comparison.predictions)), "horizon": dt * (keep + 1), "rmse": np.stack(rmse),
        "floor": findings.noise_floor[keep],
    }  # fmt: skip


def fan(findings: Findings, dt: float) -> dict[str, np.ndarray]:
    """Return predictions from some starts in the first runs, with the measurements."""
    problem, ahead = findings.comparison.problem, findings.comparison.predictions
    first = np.unique(problem.data.run, return_index=True)[1][:PANELS]  # the first piece of each run
    names = np.array([findings.names[number] for number in problem.data.run[first].tolist()])
    padded = problem.data.padded
    valid, y, commands = (np.asarray(a)[first] for a in (padded.valid, padded.y, padded.commands))
    commands = np.where(samples_in_run(valid)[..., None], commands[:, -y.shape[1] :], np.nan)
    starts = ahead["nominal"].starts
    every = max(round(EVERY / (dt * (starts[1] - starts[0]))), 1) if len(starts) > 1 else 1
    starts = starts[::every]
    keep = thin_indices(findings.noise_floor.shape[0])
    predicted = np.stack([ahead[name].readings[first][:, ::every][:, :, keep] for name in MODELS], axis=1)
    rows = starts[:, None] + 1 + keep
    driven = (rows < y.shape[1]) & samples_in_run(valid)[:, np.minimum(rows, y.shape[1] - 1)]
    return {
        "panel": names, "sample_time": dt * np.arange(y.shape[1]), "measured": np.where(valid > 0, y, np.nan),
        "delta": commands[..., 0], "Fxr": commands[..., 1],
        "start_time": dt * starts, "ahead_time": dt * (keep + 1),
        "predicted": np.where(driven[:, None, ..., None], predicted, np.nan),
    }  # fmt: skip


def force_bins(findings: Findings) -> dict[str, np.ndarray]:
    """Return the binned residual forces; omitted bins are NaN."""
    each = [findings.residual[name] for name in MODELS]
    names = [name for name in each[0].variables if all(name in one.variables for one in each)]
    pad = lambda a: np.concatenate([a, np.full((BINS - len(a), *a.shape[1:]), np.nan)])
    column = lambda pick: np.array([[pick(one.variables[name]) for name in names] for one in each])
    shape = (len(each), len(names), BINS)
    return {
        "force": np.array(FORCES), "force_limit": findings.limits, "driver": np.array(names),
        "bin_value": column(lambda one: pad(one.value)).reshape(shape),
        "bin_mean": column(lambda one: pad(one.mean)).reshape(*shape, 3),
        "bin_error": column(lambda one: pad(one.error)).reshape(*shape, 3),
        "explained": column(lambda one: one.explained).reshape(len(each), len(names), 3),
    }  # fmt: skip


def score_data(problem: Problem, selection: Selection, findings: Findings) -> dict[str, np.ndarray]:
    """Return the scores at the nominal car, and the cosines of the parameters' signatures at the extended car."""
    names = np.array([f"{effect.name}.{p.name}" for effect in problem.effects for p in effect.parameters])
    H = selection.scores.H
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    cosine = np.divide(np.abs(H), size[:, None] * size, out=np.full(H.shape, np.nan), where=size[:, None] * size > 0)
    return {
        "effect": np.array([effect.name for effect in problem.effects]), "promise": findings.scores.gain,
        "parameter": names, "other": names, "score": findings.scores.T,
        "named": np.isin(problem.owner, selection.selected), "cosine": np.minimum(cosine, 1.0),
    }  # fmt: skip
