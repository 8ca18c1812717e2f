"""What do logs of real cars say that the simulation gets wrong? Three public recordings, six questions.

`python -m experiments.real_logs --data FOLDER` calibrates a nominal car on some runs, diagnoses others, and writes one
run folder with its report per question, and `real_logs.json` and `real_logs.png` with the errors on held-out runs.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import tyro

import driftjax as dj
from driftjax.studies.closed_loop import add_closed_loop, load_case
from driftjax.studies.model_errors import plot_model_errors

TYRES = ("friction", "stiffness_front", "stiffness_rear")
LAGS = ("steer_lag", "drive_lag")


class Training(NamedTuple):
    """Runs and effects that a nominal car is calibrated with first."""

    log: str
    runs: tuple[str, ...]
    effects: tuple[str, ...]
    columns: str
    cut: float | None = None
    """Length of the parts of a long run [s]."""


@dataclasses.dataclass(frozen=True)
class Question:
    """Runs of a recording to diagnose, and what other work found in them."""

    name: str
    log: str
    columns: str
    vehicle: str
    runs: tuple[str, ...] = ()
    cut: float | None = None
    """Length of the parts of a long run [s]."""
    calibrated_on: Training | None = None
    """None: the shipped car, as it is."""
    forgotten: tuple[str, ...] = ()
    """Effects removed from the calibrated car, for the diagnosis to find."""
    expected: tuple[str, ...] = ()
    """Effects of which one should be named."""
    known: tuple[float, float] | None = None
    """Range of the value (first parameter, SI) that other work found; None where it gives none."""
    relative: bool = False
    """Whether `known` is the factor 1 + p over that of the calibrated car."""
    plant: str | None = None
    """Earlier question whose extended car is the plant of this one's closed-loop laps."""


GRIP = Training(
    "dart_jetracer/grip.csv", ("rubber_free/*",),
    (*TYRES, *LAGS, "rolling_resistance", "drive_gain", "steer_offset", "steer_gain"), "dart_jetracer",
)  # fmt: skip
FIRST_LAPS = Training(
    "ferrari_250lm/targa66_first_400s.csv", ("*+1@0", "*+1@?0", "*+1@1[0-4]0"),
    (*TYRES, "friction_rear", "tyre_shape", "yaw_inertia", "steer_lag"), "ferrari_250lm", 20.0,
)  # fmt: skip
QUESTIONS = (
    Question("dart_slides", "dart_jetracer/low_grip.csv", "dart_jetracer", "dart",
             ("slippery_16apr/*-16-21-24*", "slippery_16apr/*-17-02-48*"),
             calibrated_on=GRIP, expected=("friction",), known=(0.36, 0.48), relative=True),
    Question("dart_low_grip", "dart_jetracer/low_grip.csv", "dart_jetracer", "dart",
             ("slippery_16apr/2025-04-16-15-51-18*",), cut=8.0,
             calibrated_on=GRIP, expected=("friction",), known=(0.36, 0.48), relative=True,
             plant="dart_slides"),
    Question("dart_steering", "dart_jetracer/grip.csv", "dart_jetracer", "dart", ("mpcc*",), cut=10.0,
             calibrated_on=GRIP, forgotten=("steer_lag",), expected=("steer_lag", "steer_delay"), known=(0.06, 0.13)),
    Question("dart_onboard", "dart_jetracer/grip.csv", "dart_onboard", "dart", ("rubber_free/*",),
             calibrated_on=GRIP, expected=("channel_delay",), known=(0.08, 0.12)),
    Question("ferrari", "ferrari_250lm/targa66_first_400s.csv", "ferrari_250lm", "ferrari_250lm",
             ("*+1@1[68]0", "*+1@2*"), cut=20.0, calibrated_on=FIRST_LAPS,
             expected=("combined_slip", "load_transfer_long", "load_transfer_lat")),
    Question("genesis", "genesis_g80/cpg_slow_lap.csv", "genesis_g80", "genesis_g80", cut=20.0,
             expected=("sideslip_bias", "gyro_bias", "steer_gain")),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Config:
    """Diagnose measured logs of real cars."""

    data: Path = Path("../shared/data")
    """Folder with the recordings."""
    only: tuple[str, ...] = ()
    """Questions to answer; all where left out."""
    out: Path = Path("runs/real-logs")
    """Folder for everything."""


def main(cfg: Config) -> dict[str, Any]:
    """Answer the questions, write JSON and figure; returns the results by question."""
    unknown = sorted(set(cfg.only) - {question.name for question in QUESTIONS})
    if unknown:
        raise dj.BadInput(f"question '{unknown[0]}': choose from {', '.join(question.name for question in QUESTIONS)}.")
    results = {}
    for question in QUESTIONS:
        if not cfg.only or question.name in cfg.only:
            results[question.name] = diagnose_question(question, cfg)
            print(format_result(question, results[question.name]), flush=True)
    (cfg.out / "real_logs.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    plot_model_errors({name: one["gain"] for name, one in results.items()}).savefig(cfg.out / "real_logs.png", dpi=130)
    return results


def diagnose_question(question: Question, cfg: Config) -> dict[str, Any]:
    """Diagnose the question's runs into a run folder, or read the diagnosis that it holds."""
    out, plant, car = cfg.out / question.name, plant_file(question, cfg), nominal_car(question, cfg)
    if not (out / "diagnosis.json").is_file():
        write_question(question, cfg, out, plant, car)
    content, versions = (
        json.loads((out / f"{name}.json").read_text(encoding="utf-8")) for name in ("diagnosis", "versions")
    )
    kept = "verdict", "sentence", "causes", "named_by", "sizes_fitted_to", "gain", "closed_loop"
    return {key: content[key] for key in kept} | {
        "measured": {key: versions[key] for key in ("created", "commit")},
        "answer_car": content["answer"],
        "answer": answer(question, content, {one.effect: one.value for one in car.effects}),
    }


def write_question(question: Question, cfg: Config, out: Path, plant: Path | None, car: dj.VehicleConfig) -> None:
    """Write the run folder of a diagnosis: JSON, extended car, closed-loop laps on `plant`, figures and page."""
    path, course = cfg.data / question.log, load_case(plant, car) if plant else None
    log, config = dj.read_log(path, question.columns, runs=question.runs, cut=question.cut), dj.DiagnoseConfig()
    print(f"\ndiagnosing {question.name}: {path}", flush=True)
    diagnosis = dj.diagnose(car, log, config, workers=None)
    diagnosis.save(out)
    print(diagnosis.sentence, flush=True)
    if course and diagnosis.evidence:
        add_closed_loop(dj.RunFolder.open(out), course, diagnosis)
    print(f"report: {dj.write_diagnosis(out)}", flush=True)


def plant_file(question: Question, cfg: Config) -> Path | None:
    """Return the extended car that the closed-loop laps are driven on; raises `BadInput` where it is not there yet."""
    if question.plant is None:
        return None
    car = cfg.out / question.plant / "extended.yaml"
    if not car.is_file():
        raise dj.BadInput(f"question '{question.name}' drives on the extended car of '{question.plant}'; "
                          "answer that one too.")  # fmt: skip
    return car


def nominal_car(question: Question, cfg: Config) -> dj.VehicleConfig:
    """Return the car that the question starts from: the shipped one, or one calibrated on other runs."""
    vehicle = dj.load_vehicle(question.vehicle)
    if question.calibrated_on is None:
        return vehicle
    log, runs, effects, columns, cut = question.calibrated_on
    folder = cfg.out / f"{question.vehicle}_calibrated"
    if not (folder / "calibrated.yaml").is_file():
        print(f"\ncalibrating {question.vehicle}: {cfg.data / log}", flush=True)
        calibration = dj.calibrate(vehicle, dj.read_log(cfg.data / log, columns, runs=runs, cut=cut), effects)
        calibration.save(folder)
        print(calibration)
    car = dj.load_vehicle(folder / "calibrated.yaml")
    if not question.forgotten:
        return car
    effects = tuple(one for one in car.effects if one.effect not in question.forgotten)
    path = cfg.out / f"{question.name}_nominal.yaml"
    dj.write_vehicle(path, dataclasses.replace(car, effects=effects, covariance=()))
    return dj.load_vehicle(path)


def answer(question: Question, content: dict[str, Any], before: dict[str, float]) -> dict[str, Any]:
    """Return values and intervals of the expected effects, and whether each lies in the known range."""
    answers = {}
    for cause in content["causes"]:
        if cause["effect"] not in question.expected:
            continue
        for name, parameter in cause["parameters"].items():
            value, interval = parameter["value"], parameter["ci95"]
            if question.relative:
                unit = 1 + before[cause["effect"]]
                value, interval = (1 + value) / unit, [(1 + end) / unit for end in interval]
            inside = None if question.known is None else question.known[0] <= value <= question.known[1]
            answers[f"{cause['effect']}.{name}"] = {"value": value, "ci95": interval, "as_known": inside}
    return answers


def format_result(question: Question, result: dict[str, Any]) -> str:
    """Format the result of one question as text."""
    lines = [f"{question.name}: {result['verdict']}; expected {' or '.join(question.expected)}"]
    for name, one in result["answer"].items():
        low, high = one["ci95"]
        known = "" if question.known is None else f"; others: {question.known[0]:g}..{question.known[1]:g}"
        lines.append(f"  {name} = {one['value']:.3g} [{low:.3g}, {high:.3g}]{known}")
    if not result["answer"]:
        lines.append("  none of them was named")
    gain = result["gain"]
    ahead = gain["skill_horizon_s"]
    for model in ("retuned", "extended", "extended_gp") if ahead else ():
        at = gain["horizons_s"].index(ahead)
        low, high = gain["ratio_ci95"][model][at]
        lines.append(f"  {model}: error after {ahead:.2g} s on held-out runs, over that of the nominal car: "
                     f"{gain['ratio'][model][at]:.2f} [{low:.2f}, {high:.2f}]")  # fmt: skip
    lines.append(f"  answer: {result['answer_car']} car")
    if (share := gain["skill"].get("extended")) is not None:
        low, high = gain["ci95"]["extended"]
        lines.append(f"  share of the explainable error removed on held-out runs: {share:.2f} [{low:.2f}, {high:.2f}]")
    if (driven := result["closed_loop"]) and driven["difference"]:
        apart = driven["difference"]["lateral_error"]
        laps = [f"{name} {one['completed'][0]} of {one['completed'][1]}" for name, one in driven["models"].items()]
        lines.append(f"  laps completed on the car of {question.plant}: {', '.join(laps)}; lateral error changes by "
                     f"{apart['mean']:.3f} [{apart['ci95'][0]:.3f}, {apart['ci95'][1]:.3f}] m")  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, prog="python -m experiments.real_logs"))
    except dj.BadInput as error:
        sys.exit(f"real_logs: {error}")
