"""Files of a diagnosis: `diagnosis.json`, and the extended car."""

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from driftjax.diagnosis.findings import Findings, findings_json
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.gain import DECISIVE
from driftjax.diagnosis.held_out import PredictionGain
from driftjax.diagnosis.outliers import count_outliers
from driftjax.diagnosis.score import ParameterSpread
from driftjax.diagnosis.unexplained_errors import Unexplained
from driftjax.logs.columns import MEASURED
from driftjax.vehicle import EffectParameterValue, EstimatedNoise, PerChannel, VehicleConfig
from driftjax.vehicle.effect import EFFECTS

if TYPE_CHECKING:
    from driftjax.diagnosis.diagnose import Diagnosis


def diagnosis_json(diagnosis: "Diagnosis", findings: Findings | None) -> dict[str, Any]:
    """Return `diagnosis.json`, schema version 1."""
    log, evidence = diagnosis.log, diagnosis.evidence
    content = {
        "schema": 1, "verdict": str(diagnosis.verdict), "sentence": diagnosis.sentence,
        "causes": [cause._asdict() for cause in diagnosis.causes],
        "explained": None, "answer": None, "named_by": None, "sizes_fitted_to": None, "unconfirmed": [],
        "unexplained": {"p_value": None, "channel": None, "drivers": []}, "gain": gain_json(diagnosis.gain),
        "next_manoeuvre": diagnosis.proposal._asdict() if diagnosis.proposal else None,
        "show": None, "closed_loop": None,
        "data": {"sha256": log.sha256, "rows": log.rows, "notes": list(log.notes), "noise_sigma": {},
                 "outliers": count_outliers(log.runs, diagnosis.vehicle.a + diagnosis.vehicle.b)},
        "config": dataclasses.asdict(diagnosis.config), "seed": diagnosis.config.seed,
    }  # fmt: skip
    if evidence is None:
        return content
    noise = evidence.problem.noise
    content["explained"] = evidence.explained._asdict() if evidence.explained else None
    content["named_by"] = "predictions" if evidence.naming.by_predictions else "single steps"
    content["sizes_fitted_to"] = "predictions" if evidence.sizes else "likelihood"
    content["answer"], content["unconfirmed"] = evidence.answer, list(evidence.unconfirmed)
    content["unexplained"] = unexplained_json(evidence.unexplained)
    content["show"] = None if findings is None else findings_json(findings, noise)
    content["data"] |= {
        "noise_sigma": {
            name: float(sigma)
            for name, sigma, there in zip(MEASURED, noise.sigma, evidence.problem.measured, strict=True)
            if there
        },
        "process_sigma": dict(zip(MEASURED, map(float, noise.disturbance), strict=True)),
        "process_correlation_s": float(noise.correlation),
        "slow_sigma": dict(zip(MEASURED, map(float, noise.slow), strict=True)),
        "slow_correlation_s": float(noise.slow_correlation),
        "missing": evidence.unidentifiable._asdict() | {"sentence": evidence.unidentifiable.sentence},
    }
    return content


def unexplained_json(remaining: Unexplained) -> dict[str, Any]:
    """Return the unexplained errors, or those that effects only imitate; channel None without any.

    `at_first` are the variables that drive all that the nominal car gets wrong.
    """
    content = {
        "p_value": remaining.p_value,
        "channel": None,
        "drivers": [],
        "at_first": list(remaining.nominal_variables)[:2],
    }
    term, promised_gain = (
        (remaining.term, remaining.variables)
        if remaining.significant
        else (remaining.simpler, remaining.nominal_variables)
    )
    if term is None:
        return content
    return content | {
        "channel": term.channel,
        "drivers": list(promised_gain)[:2],
        "worth": promised_gain,
        "term": term._asdict(),
    }


def gain_json(gain: PredictionGain | None) -> dict[str, Any]:
    """Return the gain on the held-out runs, per model, horizon and channel."""
    if gain is None:
        return {
            "held_out_runs": [],
            "horizons_s": [],
            "rmse": {},
            "skill_horizon_s": None,
            "skill": {},
            "ci95": {},
            "ratio": {},
            "ratio_ci95": {},
            "without": {},
            "best": None,
        }
    shares = {name: one for name, one in gain.skills.items() if name != "nominal"}
    table = {
        name: {c: [float(v) for v in one.rms[:, i]] for i, c in enumerate(MEASURED)}
        for name, one in (gain.errors | {"noise_floor": gain.noise_floor}).items()
    }
    return {
        "held_out_runs": list(gain.held_out),
        "named_without_them": list(gain.named),
        "horizons_s": list(gain.noise_floor.horizons),
        "rmse": table,
        "skill_horizon_s": gain.noise_floor.horizons[DECISIVE],
        "skill": {name: one.value for name, one in shares.items()},
        "ci95": {name: list(one.ci95) for name, one in shares.items()},
        "ratio": {name: one[:, 0].tolist() for name, one in gain.ratios.items()},
        "ratio_ci95": {name: one[:, 1:].tolist() for name, one in gain.ratios.items()},
        "without": {name: dict(zip(MEASURED, one.tolist(), strict=True)) for name, one in gain.without.items()},
        "best": gain.best if "extended" in gain.ratios else None,
    }


def estimated_noise(problem: Problem) -> EstimatedNoise | None:
    """Return estimated noise as vehicle files hold it; None where that of a channel could not be estimated."""
    if problem.data.skip or not problem.data.force_known:
        return None
    noise, channels = problem.noise, lambda row: PerChannel(*map(float, row))
    slow = channels(noise.slow), float(noise.slow_correlation)
    return EstimatedNoise(channels(noise.sigma), channels(noise.disturbance), float(noise.correlation), *slow)


def extended_car(
    vehicle: VehicleConfig, problem: Problem, selected: tuple[int, ...], theta: np.ndarray, spread: ParameterSpread
) -> VehicleConfig:
    """Return the car with the effects `selected` at `theta` (K,), in typical sizes, their covariance, and the noise.

    Effects that the car had before are kept; where there are such the covariance is left out, for these data do not
    tell it.
    """
    scale, columns = np.asarray(problem.model.scale), problem.columns(selected)
    width = dict(zip(columns, spread.half_width, strict=True))
    estimates = [
        EffectParameterValue(problem.effects[i].name, p.name, float(theta[k] * scale[k]), float(width[k] * scale[k]))
        for i in sorted(selected)
        for p, k in zip(problem.effects[i].parameters, problem.columns((i,)), strict=True)
    ]
    named = {one.effect for one in estimates}
    before = [one for one in vehicle.effects if one.effect not in named]
    order = {name: i for i, name in enumerate(EFFECTS)}
    effects = tuple(sorted([*before, *estimates], key=lambda one: order[one.effect]))
    vehicle = dataclasses.replace(vehicle, effects=effects, covariance=(), noise=estimated_noise(problem))
    if before or not estimates:
        return vehicle
    matrix = spread.covariance * np.outer(scale[columns], scale[columns])
    return dataclasses.replace(vehicle, covariance=tuple(map(tuple, matrix.tolist())))
