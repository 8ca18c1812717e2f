"""From a log to a diagnosis: name on some runs, measure the gain on the others."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftjax.core import require
from driftjax.data import Log, Run
from driftjax.diagnose.evidence import Cause, causes
from driftjax.diagnose.fit import Problem, around, priced, problem, refine
from driftjax.diagnose.gain import Errors, errors_of, predict, rmse, skill
from driftjax.diagnose.runs import gains, held, pieces
from driftjax.diagnose.select import Selection, search
from driftjax.diagnose.show import Part, Show, show, show_json
from driftjax.diagnose.verdict import SHORTEST, Judgement, Verdict, judge
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import EFFECTS, Effect

RETUNED = ("friction", "stiffness_front", "stiffness_rear")  # what a person would tune without a diagnosis


@dataclass(frozen=True)
class DiagnoseConfig:
    """Options of a diagnosis."""

    held_out: int = 3
    """Every so-many-th run is kept back to measure the gain on; it takes no part in naming. 0: none is."""
    without: tuple[str, ...] = ()
    """Effects left out of the catalogue."""
    seed: int = 0
    """Of the random signs of the test and of the resampling."""

    def __post_init__(self) -> None:
        require(self.held_out == 0 or self.held_out >= 2, f"key 'held_out' is {self.held_out}; give 0, or 2 or more.")
        require(self.seed >= 0, f"key 'seed' is {self.seed}; give 0 or more.")
        unknown = sorted(set(self.without) - set(EFFECTS))
        require(not unknown, f"key 'without' names {unknown}; the catalogue holds {', '.join(EFFECTS)}.")


@dataclass(frozen=True)
class Diagnosis:
    """What was found, ready to be told."""

    vehicle: VehicleConfig
    task: Problem
    found: Selection
    causes: list[Cause]
    judgement: Judgement
    held: tuple[str, ...]  # names of the runs that the gain was measured on
    errors: dict[str, Errors]  # of the models compared
    skills: dict[str, tuple[float, tuple[float, float]]]
    show: Show
    config: DiagnoseConfig


def split(runs: tuple[Run, ...], every: int) -> tuple[tuple[Run, ...], tuple[Run, ...]]:
    """Runs to name from, and runs held out; of fewer than `every` runs none is held out."""
    if every == 0 or len(runs) < every:
        return runs, ()
    held = tuple(run for i, run in enumerate(runs) if i % every == every - 1)
    return tuple(run for run in runs if run not in held), held


def catalogue(runs: tuple[Run, ...], without: tuple[str, ...]) -> tuple[Effect, ...]:
    """Effects that these runs could tell: those whose columns every run has."""
    has = set.intersection(*(set(run.extra) for run in runs))
    return tuple(e for e in EFFECTS.values() if e.name not in without and set(e.needs) <= has)


def diagnose(
    vehicle: VehicleConfig, log: Log, config: DiagnoseConfig, report: Callable[[str], None] = lambda text: None
) -> Diagnosis | Judgement:
    """What `log` says the model of `vehicle` gets wrong; a bare judgement where the log is too short for any."""
    duration = sum(len(run.t) * run.dt for run in log.runs)
    if duration < SHORTEST:
        text = f"The log holds {duration:.1f} s; at least {SHORTEST:.0f} s are needed to tell anything."
        return Judgement(Verdict.DATA_INSUFFICIENT, text)
    use, kept = split(log.runs, config.held_out)
    report("noise and nominal car")
    task = problem(vehicle, catalogue(log.runs, config.without), use)
    report("naming")
    found = search(task, priced(task, np.zeros(len(task.lower))), config.seed)
    named = causes(task, found)
    judgement = judge(task, found, named, duration)
    report("gain")
    parts = [Part(task, use), *([Part(elsewhere(task, vehicle, kept), kept)] if kept else [])]
    ahead = {name: predict(parts[-1].task, theta) for name, theta in models(task, found, compared=bool(kept)).items()}
    errors = {name: errors_of(parts[-1].task, one) for name, one in ahead.items()} if kept else {}
    skills = {
        name: skill(errors["nominal"], one, task.noise.sigma, config.seed)
        for name, one in errors.items() if name != "nominal"
    }  # fmt: skip
    report("show")
    shown = show(vehicle, parts, found, ahead, config.seed)
    names = tuple(run.name for run in kept)
    return Diagnosis(vehicle, task, found, named, judgement, names, errors, skills, shown, config)


def elsewhere(task: Problem, vehicle: VehicleConfig, runs: tuple[Run, ...]) -> Problem:
    """The same question put to other `runs`, with the noise that `task` found."""
    data = pieces(vehicle, runs)
    return task._replace(data=data, gains=gains(task.model, data, task.noise.row(), held(data)))


def models(task: Problem, found: Selection, compared: bool) -> dict[str, np.ndarray]:
    """Parameters of the nominal car, of the extended one and, where it is `compared`, of the re-tuned one."""
    thetas = {"nominal": np.zeros(len(task.lower))}
    if compared:
        names = [effect.name for effect in task.effects]
        columns = task.columns(tuple(names.index(name) for name in RETUNED if name in names))
        thetas["retuned"] = refine(task, found.nominal, columns, around(task, found.nominal)).theta
    return thetas | {"extended": found.fit.theta}


def to_json(found: Diagnosis, log: Log) -> dict[str, Any]:
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
            "p_value": found.found.p_values[cause.effect], "parameters": parameters,
            "confusable_with": alike, "rivals": others,
        })  # fmt: skip
    noise = task.noise
    return {
        "schema": 1,
        "verdict": str(found.judgement.verdict),
        "sentence": found.judgement.sentence,
        "causes": each,
        "unexplained": {"p_value": found.found.scores.p_value, "channel": None, "drivers": []},
        "gain": gain_json(found),
        "next_manoeuvre": None,
        "show": show_json(found.show, noise),
        "data": {
            "sha256": log.sha256, "rows": log.rows, "notes": list(log.notes),
            "noise_sigma": dict(zip(("V", "beta", "r"), map(float, noise.sigma), strict=True)),
            "process_sigma": dict(zip(("V", "beta", "r"), map(float, noise.disturbance), strict=True)),
            "process_correlation_s": noise.correlation,
        },
        "config": dataclasses.asdict(found.config),
        "seed": found.config.seed,
    }  # fmt: skip


def gain_json(found: Diagnosis) -> dict[str, Any]:
    """The gain on the runs held out, per model, horizon and channel."""
    if not found.errors:
        return {"held_out_runs": [], "horizons_s": [], "rmse": {}, "skill": {}, "ci95": {}}
    table = {
        name: {c: [float(v) for v in rmse(one)[:, i]] for i, c in enumerate(("V", "beta", "r"))}
        for name, one in found.errors.items()
    }
    return {
        "held_out_runs": list(found.held),
        "horizons_s": list(found.errors["nominal"].horizons),
        "rmse": table,
        "skill": {name: value for name, (value, _) in found.skills.items()},
        "ci95": {name: list(interval) for name, (_, interval) in found.skills.items()},
    }


def extended(found: Diagnosis) -> dict[str, Any]:
    """The extended car as a mapping for `extended.yaml`: the nominal one and its named effects, with half-widths."""
    effects = {}
    scale = np.asarray(found.task.model.scale)
    for cause in found.causes:
        effect, columns = found.task.effects[cause.effect], found.task.columns((cause.effect,))
        values = zip(effect.parameters, cause.theta * scale[columns], cause.half_width * scale[columns], strict=True)
        effects[effect.name] = {p.name: {"value": float(x), "ci95_half": float(w)} for p, x, w in values}
    return {"nominal": dataclasses.asdict(found.vehicle), "effects": effects}
