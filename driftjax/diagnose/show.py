"""What the nominal car gets wrong, before and after naming: what `diagnosis.json` tells of it and figures draw."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from driftjax.data import Run
from driftjax.diagnose.binned import Found, driver, look, worst
from driftjax.diagnose.fit import Problem
from driftjax.diagnose.gain import CHANNELS, Ahead, Errors, errors_of, predict, rmse, root_mean
from driftjax.diagnose.noise import Noise
from driftjax.diagnose.observer import Path, Steps
from driftjax.diagnose.parity import CHANNELS as RATES
from driftjax.diagnose.parity import Parity, parity
from driftjax.diagnose.residual import FORCES, SETTLE, joined, limits, linearised, needed, residuals
from driftjax.diagnose.runs import whiten
from driftjax.diagnose.score import Scores
from driftjax.diagnose.select import Selection, tested
from driftjax.diagnose.smooth import floor
from driftjax.vehicle import VehicleConfig

LAGS = 1.0  # up to which innovations are correlated [s]


class Part(NamedTuple):
    """Some of the runs, and the question put to them."""

    task: Problem
    runs: Sequence[Run]


class White(NamedTuple):
    """Autocorrelation of whitened innovations after 1.. samples."""

    correlation: np.ndarray  # (L, 3)
    band: float  # within which 95 % of them lie if the model is right


class Show(NamedTuple):
    """What the figures show; models are `nominal` and `extended`."""

    limits: np.ndarray  # (3,) what the forces are measured by [N]
    noise: Noise  # that the nominal car needs when nothing else explains its errors
    errors: Errors  # of the nominal car, on all runs
    floor: np.ndarray  # (N, 3) RMS 1.. steps ahead that a right model would have, on the runs that `ahead` is of
    ahead: dict[str, Ahead]  # of each model compared, on runs held out, or on all where none are
    judged: Part
    residual: dict[str, Found]
    parity: Parity | None
    scores: Scores  # at the nominal car
    white: dict[str, White]
    worst: str


def show(
    vehicle: VehicleConfig, parts: Sequence[Part], found: Selection, ahead: dict[str, Ahead], seed: int
) -> Show:  # fmt: skip
    """Everything about the errors of the nominal and the extended car; `ahead` on the last of `parts`."""
    task, zero = parts[0].task, np.zeros_like(found.fit.theta)
    runs = [run for part in parts for run in part.runs]
    models = {"nominal": zero, "extended": found.fit.theta}
    along = {name: [linearised(part.task, theta) for part in parts] for name, theta in models.items()}
    noise = needed(task, *along["nominal"][0])
    residual = {}
    for name, paths in along.items():
        each = [residuals(vehicle, part.task, *path, noise, part.runs) for part, path in zip(parts, paths, strict=True)]
        residual[name] = look(joined(each), seed)
    whole = [predict(part.task, zero) for part in parts[:-1]] + [ahead["nominal"]]
    return Show(
        limits(vehicle), noise, both([errors_of(part.task, one) for part, one in zip(parts, whole, strict=True)]),
        expected(parts[-1].task, *along["extended"][-1], ahead["nominal"]), ahead, parts[-1], residual,
        parity(vehicle, runs, task.noise.sigma), tested(task, found.nominal, (), seed)[1],
        {name: white(parts, paths) for name, paths in along.items()}, worst(residual["nominal"], vehicle),
    )  # fmt: skip


def both(parts: Sequence[Errors]) -> Errors:
    """Errors of one model on several data sets."""
    shift = np.cumsum([0, *(part.block.max() + 1 for part in parts)])
    block = [part.block + at for part, at in zip(parts, shift[:-1], strict=True)]
    return Errors(np.concatenate([part.squares for part in parts]), parts[0].horizons, np.concatenate(block))


def expected(task: Problem, path: Path, steps: Steps, ahead: Ahead) -> np.ndarray:
    """RMS error (N, 3) that a right model would have where `ahead` is measured: sensor noise and disturbances.

    To first order around `path`; in an unstable drift this grows beyond what a car can do.
    """
    seen, num = np.asarray(task.data.track.seen), ahead.error.shape[2]
    variance = floor(path, steps, seen, task.noise, task.data.dt, ahead.starts, num)
    return root_mean(np.where(np.isfinite(ahead.error), variance, np.nan), (0, 1))


def white(parts: Sequence[Part], paths: Sequence[tuple[Path, Steps]]) -> White:
    """Autocorrelation of one model's whitened innovations over all runs."""
    dt = parts[0].task.data.dt
    skip, num = round(SETTLE / dt), max(round(LAGS / dt), 1)
    e = np.concatenate([
        np.asarray(whiten(part.task.gains, path.e))[:, skip:] for part, (path, _) in zip(parts, paths, strict=True)
    ])  # fmt: skip
    seen = np.concatenate([np.asarray(part.task.data.track.seen)[:, skip:] for part in parts])
    power = (e**2).sum(axis=(0, 1)) / seen.sum(axis=(0, 1))
    pairs = lambda a, lag: (a[:, lag:] * a[:, :-lag]).sum(axis=(0, 1))
    rows = [pairs(e, lag) / np.maximum(pairs(seen, lag), 1) / power for lag in range(1, num + 1)]
    return White(np.stack(rows), float(1.96 / np.sqrt(seen.sum(axis=(0, 1)).min())))


def show_json(shown: Show, noise: Noise) -> dict[str, Any]:
    """The block `show` of `diagnosis.json`; `noise` is what no effect of the catalogue explains."""
    by_channel = lambda values: dict(zip(CHANNELS, np.asarray(values).T.tolist(), strict=True))
    table = rmse(shown.errors)
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
