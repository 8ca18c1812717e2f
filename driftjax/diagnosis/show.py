"""What the nominal car gets wrong, before and after naming: what `diagnosis.json` tells of it and figures draw."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from driftjax.diagnosis.binned import Found, driver, look, worst
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import Ahead, Errors, open_loop, root_mean
from driftjax.diagnosis.noise import Noise
from driftjax.diagnosis.observer import Path
from driftjax.diagnosis.parity import CHANNELS as RATES
from driftjax.diagnosis.parity import Parity, parity
from driftjax.diagnosis.residual import FORCES, SETTLE, limits, linearised, needed, residuals
from driftjax.diagnosis.runs import whiten
from driftjax.diagnosis.score import Scores
from driftjax.diagnosis.select import Selection
from driftjax.logs import Run
from driftjax.logs.columns import MEASURED
from driftjax.vehicle import VehicleConfig

LAGS = 1.0  # up to which innovations are correlated [s]


class White(NamedTuple):
    """Autocorrelation of whitened innovations after 1.. samples."""

    correlation: np.ndarray  # (L, 3)
    band: float  # within which 95 % of them lie if the model is right


class Judged(NamedTuple):
    """Predictions of the models compared, on the runs held out, or on all where none are."""

    task: Problem
    ahead: dict[str, Ahead]  # `nominal` and `extended` among them
    least: np.ndarray  # (P, S, N, 3) squares of the errors that a right model would have


class Show(NamedTuple):
    """What the figures show; models are `nominal` and `extended`."""

    limits: np.ndarray  # (3,) what the forces are measured by [N]
    noise: Noise  # that the nominal car needs when nothing else explains its errors
    errors: Errors  # of the nominal car, on all runs
    judged: Judged
    floor: np.ndarray  # (N, 3) RMS 1.. steps ahead that a right model would have
    names: tuple[str, ...]  # of all runs
    residual: dict[str, Found]
    parity: Parity | None
    scores: Scores  # at the nominal car
    white: dict[str, White]
    worst: str


def show(
    vehicle: VehicleConfig, task: Problem, runs: Sequence[Run], found: Selection, judged: Judged, seed: int
) -> Show:  # fmt: skip
    """Everything about the errors of the nominal and the extended car on all `runs`, those of `task`."""
    zero, base = found.nominal.theta, found.base
    along = {"nominal": linearised(base, zero), "extended": (found.at.path, found.at.steps)}
    noise = needed(base, *along["nominal"])
    residual = {name: look(residuals(vehicle, task, *path, noise, runs), seed) for name, path in along.items()}
    whiteness = {"nominal": white(base, along["nominal"][0]), "extended": white(task, found.at.path)}
    measured = np.isfinite(judged.ahead["nominal"].error)
    return Show(
        limits(vehicle), noise, open_loop(base, zero), judged,
        root_mean(np.where(measured, judged.least, np.nan), (0, 1)), tuple(run.name for run in runs), residual,
        parity(vehicle, runs, task.noise.sigma), found.first,
        whiteness, worst(residual["nominal"], vehicle),
    )  # fmt: skip


def white(task: Problem, path: Path) -> White:
    """Autocorrelation of one model's whitened innovations."""
    skip, num = round(SETTLE / task.data.dt), max(round(LAGS / task.data.dt), 1)
    e, seen = np.asarray(whiten(task.gains, path.e))[:, skip:], np.asarray(path.seen)[:, skip:]
    power = (e**2).sum(axis=(0, 1)) / seen.sum(axis=(0, 1))
    pairs = lambda a, lag: (a[:, lag:] * a[:, :-lag]).sum(axis=(0, 1))
    rows = [pairs(e, lag) / np.maximum(pairs(seen, lag), 1) / power for lag in range(1, num + 1)]
    return White(np.stack(rows), float(1.96 / np.sqrt(seen.sum(axis=(0, 1)).min())))


def show_json(shown: Show, noise: Noise) -> dict[str, Any]:
    """The block `show` of `diagnosis.json`; `noise` is what no effect of the catalogue explains."""
    by_channel = lambda values: dict(zip(MEASURED, np.asarray(values).T.tolist(), strict=True))
    table = shown.errors.rms
    return {
        "noise": {
            "measurement": by_channel(noise.sigma), "process": by_channel(noise.disturbance),
            "process_of_nominal": by_channel(shown.noise.disturbance),
        },
        "open_loop": {
            "horizons_s": list(shown.errors.horizons), "rmse": by_channel(table),
            "in_noises": by_channel(table / noise.sigma),
        },
        "residual_forces": {
            "p_value": shown.residual["nominal"].p_value,
            **{name: _force_json(shown, i) for i, name in enumerate(FORCES)},
        },
        "kinematic_parity": None if shown.parity is None else _parity_json(shown.parity),
        "worst": shown.worst,
    }  # fmt: skip


def _force_json(shown: Show, force: int) -> dict[str, Any]:
    before, after = shown.residual["nominal"], shown.residual["extended"]
    name = driver(before, force)
    return {
        "rms_N": float(before.rms[force]), "rms_extended_N": float(after.rms[force]),
        "share_of_limit": float(before.rms[force] / shown.limits[force]), "worst_variable": name,
        "explained": {variable: float(one.explained[force]) for variable, one in before.over.items()},
    }  # fmt: skip


def _parity_json(found: Parity) -> dict[str, Any]:
    columns = ("mean", "z", "rms", "floor", "excess")
    rates = {
        name: {key: float(getattr(found, key)[i]) for key in columns} | {"unit": unit}
        for i, (name, unit) in enumerate(zip(RATES, ("m/s^2", "rad/s"), strict=True))
    }
    return rates | {"windows": found.num, "statement": found.statement}
