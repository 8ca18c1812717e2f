"""A diagnosis as files tell it: `diagnosis.json` and the extended car."""

import dataclasses
from typing import Any

import numpy as np

from driftjax.diagnosis.diagnose import Diagnosis, Gain
from driftjax.diagnosis.evidence import half_widths
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.score import Scores, covariance
from driftjax.diagnosis.show import Show, show_json
from driftjax.diagnosis.unknown import Unexplained
from driftjax.diagnosis.verdict import Judgement
from driftjax.logs import Log
from driftjax.logs.columns import MEASURED
from driftjax.vehicle import VehicleConfig


def to_json(found: Diagnosis, log: Log, shown: Show | None = None) -> dict[str, Any]:
    """`diagnosis.json`, schema version 1."""
    task, scale = found.task, np.asarray(found.task.model.scale)
    each = []
    for cause in found.causes:
        effect, columns = task.effects[cause.effect], task.columns((cause.effect,))
        rows = zip(effect.parameters, cause.theta, cause.half_width, scale[columns], strict=True)
        parameters = {
            p.name: {"value": x * s, "ci95": [(x - w) * s, (x + w) * s], "unit": p.unit} for p, x, w, s in rows
        }
        others = {task.effects[i].name: p for i, p in cause.rivals.items()}
        alike = sorted({*others, *(task.effects[i].name for i in cause.alike)})
        each.append({
            "effect": effect.name, "probability": cause.probability,
            "p_value": cause.p_value, "parameters": parameters, "invariance": cause.invariance,
            "confusable_with": alike, "rivals": others,
        })  # fmt: skip
    noise = task.noise
    return {
        "schema": 1,
        "verdict": str(found.judgement.verdict),
        "sentence": found.judgement.sentence,
        "causes": each,
        "unexplained": unexplained_json(found.left),
        "gain": gain_json(found.gain),
        "next_manoeuvre": found.proposal._asdict() if found.proposal else None,
        "show": None if shown is None else show_json(shown, noise),
        "closed_loop": None,
        "data": _data(log) | {
            "noise_sigma": dict(zip(MEASURED, map(float, noise.sigma), strict=True)),
            "process_sigma": dict(zip(MEASURED, map(float, noise.disturbance), strict=True)),
            "process_correlation_s": noise.correlation,
        },
        "config": dataclasses.asdict(found.config),
        "seed": found.config.seed,
    }  # fmt: skip


def bare_json(judgement: Judgement, log: Log, seed: int) -> dict[str, Any]:
    """`diagnosis.json` of data that say nothing."""
    return {
        "schema": 1, "verdict": str(judgement.verdict), "sentence": judgement.sentence, "causes": [],
        "unexplained": {"p_value": None, "channel": None, "drivers": []}, "gain": gain_json(None),
        "next_manoeuvre": None, "show": None, "closed_loop": None, "data": _data(log) | {"noise_sigma": {}},
        "seed": seed,
    }  # fmt: skip


def _data(log: Log) -> dict[str, Any]:
    return {"sha256": log.sha256, "rows": log.rows, "notes": list(log.notes)}


def unexplained_json(left: Unexplained) -> dict[str, Any]:
    """What is left, or what effects only imitate; neither channel nor drivers where that is nothing.

    `at_first` are the variables that drive all that the nominal car gets wrong.
    """
    told = {"p_value": left.p_value, "channel": None, "drivers": [], "at_first": list(left.at_first)[:2]}
    term, worth = (left.term, left.drivers) if left.found else (left.simpler, left.at_first)
    if term is None:
        return told
    return told | {"channel": term.channel, "drivers": list(worth)[:2], "worth": worth, "term": term._asdict()}


def gain_json(gain: Gain | None) -> dict[str, Any]:
    """The gain on the runs held out, per model, horizon and channel."""
    if gain is None:
        return {
            "held_out_runs": [],
            "horizons_s": [],
            "rmse": {},
            "skill": {},
            "ci95": {},
            "ratio": {},
            "ratio_ci95": {},
        }
    table = {
        name: {c: [float(v) for v in one.rms[:, i]] for i, c in enumerate(MEASURED)}
        for name, one in (gain.errors | {"noise_floor": gain.floor}).items()
    }
    return {
        "held_out_runs": list(gain.held),
        "named_without_them": list(gain.named),
        "horizons_s": list(gain.floor.horizons),
        "rmse": table,
        "skill": {name: value for name, (value, _) in gain.skills.items()},
        "ci95": {name: list(interval) for name, (_, interval) in gain.skills.items()},
        "ratio": {name: one[:, 0].tolist() for name, one in gain.ratios.items()},
        "ratio_ci95": {name: one[:, 1:].tolist() for name, one in gain.ratios.items()},
    }


def extended(found: Diagnosis) -> dict[str, Any]:
    """The extended car as a mapping for `extended.yaml`, which `load_vehicle` reads: nominal car and named effects."""
    last = found.found
    return extended_car(found.vehicle, found.task, last.members, last.fit.theta, last.scores)


def extended_car(
    vehicle: VehicleConfig, task: Problem, members: tuple[int, ...], theta: np.ndarray, last: Scores
) -> dict[str, Any]:
    """The car with the effects `members` at `theta` (K,), in typical sizes, as a mapping that `load_vehicle` reads.

    The nominal car; these effects with half-widths; and the covariance of all their parameters, SI, whose rows go
    through effects and parameters in the catalogue's order, as `parameters` says beside it. Effects that the car had
    before are kept; where there are such the covariance is left out, for these data do not tell it.
    """
    effects, names, before = dict[str, Any](), [], {task.effects[i].name for i in members}
    for one in vehicle.effects:
        effects.setdefault(one.effect, {})[one.parameter] = {"value": one.value, "ci95_half": one.ci95_half}
    scale, columns = np.asarray(task.model.scale), task.columns(members)
    width = dict(zip(columns, half_widths(task, last, members), strict=True))
    for member in sorted(members):
        effect, own = task.effects[member], task.columns((member,))
        values = zip(effect.parameters, own, strict=True)
        sizes = {p.name: (theta[k] * scale[k], width[k] * scale[k]) for p, k in values}
        effects[effect.name] = {name: {"value": float(x), "ci95_half": float(w)} for name, (x, w) in sizes.items()}
        names += [f"{effect.name}.{p.name}" for p in effect.parameters]
    nominal = dataclasses.asdict(vehicle)
    car = {"nominal": {key: nominal[key] for key in nominal if key not in ("effects", "covariance")}}
    if not names or set(effects) != before:
        return car | {"effects": effects}
    matrix = covariance(last.H, last.blocks, columns) * np.outer(scale[columns], scale[columns])
    return car | {"effects": effects, "covariance": {"parameters": names, "matrix": matrix.tolist()}}
