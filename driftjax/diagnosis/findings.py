"""Errors of the nominal and the extended car: content of `diagnosis.json` and of the figures."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from driftjax.diagnosis.comparison import Comparison
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.force_bins import ForceSummary, best_variable, describe_worst, summarise_forces
from driftjax.diagnosis.gain import Errors, open_loop_errors, root_mean_square
from driftjax.diagnosis.noise_model import Noise
from driftjax.diagnosis.observer import Path
from driftjax.diagnosis.parity import CHANNELS as RATES
from driftjax.diagnosis.parity import Parity, parity
from driftjax.diagnosis.residual import (
    FORCES,
    SKIPPED_START,
    force_limits,
    nominal_noise,
    observer_path,
    residual_forces,
)
from driftjax.diagnosis.runs import whiten
from driftjax.diagnosis.score import Scores
from driftjax.diagnosis.select import Selection
from driftjax.logs import Run
from driftjax.logs.columns import MEASURED
from driftjax.vehicle import VehicleConfig

LAGS = 1.0  # up to which innovations are correlated [s]


class Autocorrelation(NamedTuple):
    """Autocorrelation of whitened innovations after 1.. samples."""

    correlation: np.ndarray  # (L, 3)
    band: float  # within which 95 % of them lie if the model is right


class Findings(NamedTuple):
    """Errors of the models `nominal` and `extended`, as the figures draw them."""

    limits: np.ndarray  # (3,) what the forces are measured by [N]
    noise: Noise  # that the nominal car needs when nothing else explains its errors
    errors: Errors  # of the nominal car, on all runs
    comparison: Comparison
    noise_floor: np.ndarray  # (N, 3) RMS 1.. steps ahead that a right model would have
    names: tuple[str, ...]  # of all runs
    residual: dict[str, ForceSummary]
    parity: Parity | None
    scores: Scores  # at the nominal car
    autocorrelation: dict[str, Autocorrelation]
    worst: str


def describe_errors(
    vehicle: VehicleConfig, problem: Problem, runs: Sequence[Run], selection: Selection, comparison: Comparison,
    seed: int, refitted: np.ndarray | None = None,
) -> Findings:  # fmt: skip
    """Compute the errors of the nominal and the extended car on all `runs`, those of `problem`.

    The latter is that of the selection, or `refitted` (K,).
    """
    zero, base = selection.nominal.theta, selection.base
    last = selection.linearisation
    along = {
        "nominal": observer_path(base, zero),
        "extended": (last.path, last.steps) if refitted is None else observer_path(problem, refitted),
    }
    noise = nominal_noise(base, *along["nominal"])
    residual = {
        name: summarise_forces(residual_forces(vehicle, problem, *path, noise, runs), seed)
        for name, path in along.items()
    }
    whiteness = {
        "nominal": autocorrelation(base, along["nominal"][0]),
        "extended": autocorrelation(problem, along["extended"][0]),
    }
    return Findings(
        force_limits(vehicle), noise, open_loop_errors(base, zero), comparison,
        root_mean_square(comparison.least, (0, 1)), tuple(run.name for run in runs), residual,
        parity(vehicle, runs, problem.noise.total), selection.nominal_scores,
        whiteness, describe_worst(residual["nominal"], vehicle),
    )  # fmt: skip


def autocorrelation(problem: Problem, path: Path) -> Autocorrelation:
    """Return the autocorrelation of one model's whitened innovations."""
    skip, num = round(SKIPPED_START / problem.data.dt), max(round(LAGS / problem.data.dt), 1)
    e, valid = np.asarray(whiten(problem.gains, path.e))[:, skip:], np.asarray(path.valid)[:, skip:]
    valid = valid * problem.data.informative[skip:]
    num_valid = valid.sum(axis=(0, 1))
    power = np.where(num_valid > 0, (e**2).sum(axis=(0, 1)) / np.maximum(num_valid, 1), np.nan)
    pairs = lambda a, lag: (a[:, lag:] * a[:, :-lag]).sum(axis=(0, 1))
    rows = [pairs(e, lag) / np.maximum(pairs(valid, lag), 1) / power for lag in range(1, num + 1)]
    return Autocorrelation(np.stack(rows), float(1.96 / np.sqrt(num_valid[num_valid > 0].min())))


def findings_json(findings: Findings, noise: Noise) -> dict[str, Any]:
    """Return the block `show` of `diagnosis.json`; `noise` is what no effect of the catalogue explains."""
    by_channel = lambda values: dict(zip(MEASURED, np.asarray(values).T.tolist(), strict=True))
    table = findings.errors.rms
    return {
        "noise": {
            "measurement": by_channel(noise.sigma), "slow": by_channel(noise.slow),
            "process": by_channel(noise.disturbance),
            "process_of_nominal": by_channel(findings.noise.disturbance),
        },
        "open_loop": {
            "horizons_s": list(findings.errors.horizons), "rmse": by_channel(table),
            "in_noises": by_channel(table / noise.total),
        },
        "residual_forces": {
            "p_value": findings.residual["nominal"].p_value,
            **{name: _force_json(findings, i) for i, name in enumerate(FORCES)},
        },
        "kinematic_parity": None if findings.parity is None else _parity_json(findings.parity),
        "worst": findings.worst,
    }  # fmt: skip


def _force_json(findings: Findings, force: int) -> dict[str, Any]:
    before, after = findings.residual["nominal"], findings.residual["extended"]
    name = best_variable(before, force)
    return {
        "rms_N": float(before.rms[force]), "rms_extended_N": float(after.rms[force]),
        "share_of_limit": float(before.rms[force] / findings.limits[force]), "worst_variable": name,
        "explained": {variable: float(one.explained[force]) for variable, one in before.variables.items()},
    }  # fmt: skip


def _parity_json(result: Parity) -> dict[str, Any]:
    columns = ("mean", "z", "rms", "floor", "excess")
    rates = {
        name: {key: float(getattr(result, key)[i]) for key in columns} | {"unit": unit}
        for i, (name, unit) in enumerate(zip(RATES, ("m/s^2", "rad/s"), strict=True))
    }
    return rates | {"windows": result.num, "statement": result.statement}
