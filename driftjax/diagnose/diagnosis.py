"""From a log to a diagnosis: name on some runs, measure the gain on the others."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftjax.core import require
from driftjax.data import Log
from driftjax.data.columns import MEASURED
from driftjax.diagnose.evidence import Cause, causes
from driftjax.diagnose.fit import Fit, Problem, priced, problem, refine
from driftjax.diagnose.gain import Errors, floor, open_loop, skill
from driftjax.diagnose.learnt import learnt
from driftjax.diagnose.propose import Proposal, propose
from driftjax.diagnose.score import covariance
from driftjax.diagnose.select import Selection, search
from driftjax.diagnose.unknown import Unexplained, unexplained
from driftjax.diagnose.verdict import SHORTEST, Judgement, Verdict, judge
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import EFFECTS, Effect

RETUNED = ("friction", "stiffness_front", "stiffness_rear")  # what a person would tune without a diagnosis


@dataclass(frozen=True)
class DiagnoseConfig:
    """Options of a diagnosis."""

    held_out: int = 3
    """Every so-many-th run is held out to measure the gain on: effects are named and fitted once more without them.
    0: none is, and no gain is measured."""
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
class Gain:
    """What the extension gains on runs held out, when named and fitted without them."""

    held: tuple[str, ...]  # names of the runs held out
    named: tuple[str, ...]  # effects named without them
    errors: dict[str, Errors]  # of the models compared
    floor: Errors  # what noise alone makes
    skills: dict[str, tuple[float, tuple[float, float]]]


@dataclass(frozen=True)
class Diagnosis:
    """What was found, ready to be told."""

    vehicle: VehicleConfig
    task: Problem
    found: Selection
    causes: list[Cause]
    left: Unexplained
    judgement: Judgement
    proposal: Proposal | None
    gain: Gain | None  # None where there are too few runs to hold any out
    config: DiagnoseConfig


def split(num: int, every: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the runs to name from, and of those held out; of fewer than `every` runs none is held out."""
    runs = np.arange(num)
    held = runs % every == every - 1 if every else np.zeros(num, bool)
    return runs[~held], runs[held]


def diagnose(
    vehicle: VehicleConfig,
    log: Log,
    config: DiagnoseConfig,
    report: Callable[[str], None] = lambda text: None,
    effects: tuple[Effect, ...] = tuple(EFFECTS.values()),
) -> Diagnosis | Judgement:
    """What `log` says the model of `vehicle` gets wrong; a bare judgement where the log is too short for any.

    Causes are named from all runs. The gain is that of what is named and fitted without the runs held out. `effects`
    is the catalogue to choose from: another one is another model to compile.
    """
    duration = sum(len(run.t) * run.dt for run in log.runs)
    if duration < SHORTEST:
        text = f"The log holds {duration:.1f} s; at least {SHORTEST:.0f} s are needed to tell anything."
        return Judgement(Verdict.DATA_INSUFFICIENT, text)
    report("noise and nominal car")
    task = problem(vehicle, effects, log.runs, config.without)
    report("naming")
    found = search(task, nominal(task), config.seed)
    named = causes(task, found)
    left = unexplained(task, found, config.seed)
    judgement = judge(task, found, named, left, duration)
    proposal = propose(vehicle, task, found, named, judgement, config.seed)
    report("gain")
    gain = measure(task, tuple(run.name for run in log.runs), config)
    return Diagnosis(vehicle, task, found, named, left, judgement, proposal, gain, config)


def nominal(task: Problem) -> Fit:
    """The car without any effect."""
    return priced(task, np.zeros(len(task.lower)))


def measure(task: Problem, names: tuple[str, ...], config: DiagnoseConfig) -> Gain | None:
    """Open-loop errors on the runs held out of the nominal car, the re-tuned one, the extended one, and both ends with
    a GP on what they lack; with skills."""
    use, held = split(len(names), config.held_out)
    if not len(held):
        return None
    train, test = task.part(use), task.part(held)
    found = search(train, nominal(train), config.seed)
    effects = [effect.name for effect in task.effects]
    columns = task.columns(tuple(effects.index(name) for name in RETUNED if name in effects))
    tuned = refine(train, found.nominal, columns[task.asked[columns]])
    thetas = {"nominal": found.nominal.theta, "retuned": tuned.theta, "extended": found.fit.theta}
    errors = {name: open_loop(test, theta) for name, theta in thetas.items()}
    for name, base in (("gp", "nominal"), ("extended_gp", "extended")):
        errors[name] = open_loop(test, thetas[base], learnt(train, thetas[base], config.seed))
    least = floor(test, found.fit.theta)
    skills = {name: skill(errors["nominal"], one, least, config.seed) for name, one in errors.items()}
    del skills["nominal"]
    named = tuple(effects[i] for i in found.members)
    return Gain(tuple(names[i] for i in held), named, errors, least, skills)


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
            "p_value": found.found.p_values[cause.effect], "parameters": parameters, "invariance": cause.invariance,
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
        "data": {
            "sha256": log.sha256, "rows": log.rows, "notes": list(log.notes),
            "noise_sigma": dict(zip(MEASURED, map(float, noise.sigma), strict=True)),
            "process_sigma": dict(zip(MEASURED, map(float, noise.disturbance), strict=True)),
            "process_correlation_s": noise.correlation,
        },
        "config": dataclasses.asdict(found.config),
        "seed": found.config.seed,
    }  # fmt: skip


def unexplained_json(left: Unexplained) -> dict[str, Any]:
    """What is left; neither channel nor drivers where that is nothing."""
    if not left.found:
        return {"p_value": left.p_value, "channel": None, "drivers": []}
    return {
        "p_value": left.p_value, "channel": left.term.channel, "drivers": list(left.drivers)[:2],
        "worth": left.drivers, "term": left.term._asdict(),
    }  # fmt: skip


def gain_json(gain: Gain | None) -> dict[str, Any]:
    """The gain on the runs held out, per model, horizon and channel."""
    if gain is None:
        return {"held_out_runs": [], "horizons_s": [], "rmse": {}, "skill": {}, "ci95": {}}
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
    }


def extended(found: Diagnosis) -> dict[str, Any]:
    """The extended car as a mapping for `extended.yaml`, which `load_vehicle` reads.

    The nominal car; its named effects with half-widths; and the covariance of all their parameters, SI, whose rows go
    through effects and parameters in the catalogue's order, as `parameters` says beside it.
    """
    task, effects, names = found.task, {}, []
    scale = np.asarray(task.model.scale)
    for cause in sorted(found.causes, key=lambda cause: cause.effect):
        effect, columns = task.effects[cause.effect], task.columns((cause.effect,))
        values = zip(effect.parameters, cause.theta * scale[columns], cause.half_width * scale[columns], strict=True)
        effects[effect.name] = {p.name: {"value": float(x), "ci95_half": float(w)} for p, x, w in values}
        names += [f"{effect.name}.{p.name}" for p in effect.parameters]
    nominal = dataclasses.asdict(found.vehicle)
    car = {"nominal": {key: nominal[key] for key in nominal if key not in ("effects", "covariance")}}
    if not names:
        return car | {"effects": {}}
    columns = task.columns(found.found.members)
    last = found.found.scores
    matrix = covariance(last.H, last.blocks, columns) * np.outer(scale[columns], scale[columns])
    return car | {"effects": effects, "covariance": {"parameters": names, "matrix": matrix.tolist()}}
