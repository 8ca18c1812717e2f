"""Drive and diagnose one case, and compare the result with its truth."""

import dataclasses
import time
from typing import Any

import numpy as np

from driftjax.core.config import to_dict
from driftjax.diagnosis.diagnose import Diagnosis, Evidence, diagnose
from driftjax.diagnosis.gain import excess_shares, open_loop_errors
from driftjax.diagnosis.held_out import DiagnoseConfig
from driftjax.diagnosis.score import CONDITION, partial_out
from driftjax.diagnosis.serialise import unexplained_json
from driftjax.logs import Log, Run
from driftjax.manoeuvres.campaign import LATER, Campaign, record_runs
from driftjax.studies.hidden_effects.against_truth import costs_against
from driftjax.studies.hidden_effects.case import FOREIGN, Case
from driftjax.studies.hidden_effects.foreign_simulator import foreign_runs, foreign_vehicle, height
from driftjax.vehicle import VehicleConfig, load_vehicle
from driftjax.vehicle.effect import EFFECTS, Effect, default_catalogue

ATTEMPTS = 4  # at runs in which the car does not spin
APART = 2**32  # between the seeds of attempts


def nominal_vehicle(case: Case) -> VehicleConfig:
    """Return the nominal car of a case, with a friction circle for drifts."""
    if case.car in FOREIGN:
        return foreign_vehicle()
    return dataclasses.replace(load_vehicle(case.car), combined_slip=1.0)


def measured_runs(case: Case, vehicle: VehicleConfig) -> tuple[Run, ...]:
    """Return the runs of a case; a run that spins is driven again, and omitted when it always does."""
    if case.car in FOREIGN:
        return foreign_runs(case.car, case.seed, case.noise)
    theta, runs_of = case.theta(tuple(EFFECTS.values())), dict[str, Run]()
    campaign = Campaign(case.manoeuvres, noise=case.noise, process_noise=case.process_noise, seed=case.seed)
    for attempt in range(ATTEMPTS):
        runs, truth = record_runs(vehicle, theta, dataclasses.replace(campaign, seed=case.seed + attempt * APART))
        runs_of = {run.name: run for run in runs} | runs_of
        missing = set(truth.left_out) - set(runs_of)
        if not missing:
            break
    return tuple(runs_of[name] for name in sorted(runs_of, key=lambda name: int(name.rsplit("-", 1)[1])))


def run_case(case: Case) -> dict[str, Any]:
    """Drive, diagnose and compare one case; return plain values for one line of JSON."""
    start = time.perf_counter()
    vehicle = nominal_vehicle(case)
    runs = measured_runs(case, vehicle)
    seconds = time.perf_counter() - start
    effects, poor = default_catalogue(*case.names), case.condition == "poor"
    result = diagnose_case(case, vehicle, runs, effects, 0 if poor else 3) | {"seconds_drive": seconds}
    if poor and result["proposed"]:
        case = dataclasses.replace(case, manoeuvres=(result["proposed"],), seed=case.seed + LATER)
        more = tuple(dataclasses.replace(run, name=f"next-{run.name}") for run in measured_runs(case, vehicle))
        result |= {"after": diagnose_case(case, vehicle, (*runs, *more), effects, 0)}
    return result


def diagnose_case(
    case: Case, vehicle: VehicleConfig, runs: tuple[Run, ...], effects: tuple[Effect, ...], held_out: int = 3
) -> dict[str, Any]:
    """Diagnose `runs` with the catalogue `effects` and compare the result with the truth of `case`.

    The gain is measured on every `held_out`-th run; 0: on none, which takes half the time.
    """
    log, start = Log(runs), time.perf_counter()
    config = DiagnoseConfig(held_out, case.without, gp=False, seed=case.seed)
    diagnosis = diagnose(vehicle, log, config, effects=effects)
    evidence = diagnosis.evidence
    if evidence is None:
        raise RuntimeError(f"{len(runs)} runs are left: {diagnosis.sentence}")
    result = {"case": to_dict(case), "group": case.group, "seconds": time.perf_counter() - start, "runs": len(runs)}
    result |= diagnosis_values(diagnosis, evidence)
    result |= {"hidden": [compare_hidden(evidence, case, name) for name in case.names if name not in case.without]}
    if case.condition == "foreign":
        return result | {"height": height(case.car)}
    if diagnosis.gain and case.effects:
        gain = diagnosis.gain
        oracle = open_loop_errors(gain.comparison.problem, case.theta(effects))
        if shares := excess_shares(gain.errors | {"oracle": oracle}, gain.noise_floor, config.seed):
            result |= {"oracle": [shares["oracle"].value, *shares["oracle"].ci95]}
    if set(result["named"]) != set(case.names):
        problem = evidence.problem
        members = tuple(i for i, effect in enumerate(problem.effects) if effect.name in case.names)
        result |= {"prices": costs_against(evidence, case.theta(problem.effects), members)}
    return result


def diagnosis_values(diagnosis: Diagnosis, evidence: Evidence) -> dict[str, Any]:
    """Return the diagnosis as plain values; parameters in typical sizes."""
    problem, name = evidence.problem, lambda i: evidence.problem.effects[i].name
    causes = [
        {
            "effect": name(c.effect), "probability": c.probability, "p_value": c.p_value,
            "theta": c.theta.tolist(), "half_width": c.half_width.tolist(),
            "scale": np.asarray(problem.model.scale)[problem.columns((c.effect,))].tolist(),
            "rivals": {name(i): p for i, p in c.rivals.items()}, "alike": [name(i) for i in c.confusable],
            "invariance": c.invariance,
        }
        for c in evidence.causes
    ]  # fmt: skip
    skills = diagnosis.gain.skills if diagnosis.gain else {}
    noise = problem.noise.as_vector()
    return {
        "proposed": diagnosis.proposal.manoeuvre if diagnosis.proposal else None, "verdict": str(diagnosis.verdict),
        "sentence": diagnosis.sentence, "causes": causes,
        "named": [c["effect"] for c in causes], "p_first": evidence.selection.nominal_scores.p_value,
        "p_left": evidence.unexplained.p_value, "gain_left": evidence.unexplained.gain,
        "unexplained": unexplained_json(evidence.unexplained), "noise": [float(v) for v in noise],
        "skill": {model: [one.value, *one.ci95] for model, one in skills.items() if model != "nominal"},
    }  # fmt: skip


def compare_hidden(evidence: Evidence, case: Case, name: str) -> dict[str, Any]:
    """Return test and rank of a hidden effect at the nominal car, its most similar effects and, if named, estimate."""
    problem = evidence.problem
    effect = [e.name for e in problem.effects].index(name)
    columns = problem.columns((effect,))
    first = evidence.selection.nominal_scores
    info = np.diag(first.H)[columns]
    result: dict[str, Any] = {
        "effect": name, "strengths": list(next(h.strengths for h in case.effects if h.name == name)),
        "deviations": float(np.sqrt(info.max())), "T": float(np.abs(first.T[columns]).max()),
        "gain": float(first.gain[effect]), "rank": int(np.sum(first.gain > first.gain[effect])),
    }  # fmt: skip
    others = tuple(i for i, e in enumerate(problem.effects) if e.name in case.names and i != effect)
    result["alike"] = nearest_effects(evidence, first.H, int(columns[np.argmax(info)]), problem.columns(others))
    for cause in evidence.causes:
        if cause.effect == effect:
            result |= {"theta": cause.theta.tolist(), "half_width": cause.half_width.tolist()}
    return result


def nearest_effects(evidence: Evidence, H: np.ndarray, column: int, taken: np.ndarray) -> dict[str, float]:
    """Return the cosine of the signature of parameter `column` with the most similar effect and all named ones.

    Parameters `taken` are projected out of every signature.
    """
    P, owner, information = partial_out(H, taken), evidence.problem.owner, np.diag(H)
    H = P.T @ H @ P
    own = np.diag(H) > CONDITION * information
    cosine = np.where(
        own & own[column], np.abs(H[column]) / np.sqrt(np.where(own, np.diag(H) * H[column, column], 1)), 0
    )
    cosine[taken] = 0.0
    of = {i: float(cosine[owner == i].max()) for i in set(owner.tolist()) if i != owner[column]}
    result = {max(of, key=lambda i: of[i]), *(c.effect for c in evidence.causes)} & set(of)
    return {evidence.problem.effects[i].name: of[i] for i in result}
