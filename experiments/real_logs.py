"""What do logs of real cars say that the simulation gets wrong? Three public recordings, six questions.

`python -m experiments.real_logs --data FOLDER` calibrates a nominal car on some runs, asks others, and writes one
folder with the whole report per question, `real_logs.json` and `real_logs.png` with the gains on runs held out.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
import yaml
from matplotlib.figure import Figure

from driftjax.cli import main as driftjax
from driftjax.core import BadInput, write_atomically
from driftjax.report.style import COMPARED
from driftjax.vehicle import load_vehicle

TYRES = ("friction", "stiffness_front", "stiffness_rear")
LAGS = ("steer_lag", "drive_lag")
SECOND = 1.0  # horizon that the figure shows [s]


class Trained(NamedTuple):
    """What a nominal car is calibrated on first."""

    log: str
    runs: tuple[str, ...]
    effects: tuple[str, ...]
    columns: str
    cut: float | None = None
    """Length of the parts of a long run [s]."""


@dataclasses.dataclass(frozen=True)
class Question:
    """Runs of a recording put to `driftjax diagnose`, and what others found in them."""

    name: str
    log: str
    columns: str
    vehicle: str
    runs: tuple[str, ...] = ()
    cut: float | None = None
    """Length of the parts of a long run [s]."""
    calibrated_on: Trained | None = None
    """None: the file's car, as it is."""
    forgotten: tuple[str, ...] = ()
    """Effects taken out of the calibrated car again, for the diagnosis to find."""
    looked_for: tuple[str, ...] = ()
    """Effects of which one is to be named."""
    known: tuple[float, float] | None = None
    """Range of the value (first parameter, SI) that other work found; None where it told none."""
    relative: bool = False
    """Whether that is the factor 1 + p over that of the calibrated car."""
    plant: str | None = None
    """Question asked before, whose car is driven on with the models of this one."""


GRIP = Trained(
    "dart_jetracer/grip.csv", ("rubber_free/*",),
    (*TYRES, *LAGS, "rolling_resistance", "drive_gain", "steer_offset", "steer_gain"), "dart_jetracer",
)  # fmt: skip
FIRST_LAPS = Trained(
    "ferrari_250lm/targa66_first_400s.csv", ("*+1@0", "*+1@?0", "*+1@1[0-4]0"),
    (*TYRES, "friction_rear", "tyre_shape", "yaw_inertia", "steer_lag"), "ferrari_250lm", 20.0,
)  # fmt: skip
QUESTIONS = (
    Question("dart_slides", "dart_jetracer/low_grip.csv", "dart_jetracer", "dart",
             ("slippery_16apr/*-16-21-24*", "slippery_16apr/*-17-02-48*"),
             calibrated_on=GRIP, looked_for=("friction",), known=(0.36, 0.48), relative=True),
    Question("dart_low_grip", "dart_jetracer/low_grip.csv", "dart_jetracer", "dart",
             ("slippery_16apr/2025-04-16-15-51-18*",), cut=8.0,
             calibrated_on=GRIP, looked_for=("friction",), known=(0.36, 0.48), relative=True,
             plant="dart_slides"),
    Question("dart_steering", "dart_jetracer/grip.csv", "dart_jetracer", "dart", ("mpcc*",), cut=10.0,
             calibrated_on=GRIP, forgotten=("steer_lag",), looked_for=("steer_lag", "steer_delay"), known=(0.06, 0.13)),
    Question("dart_onboard", "dart_jetracer/grip.csv", "dart_onboard", "dart", ("rubber_free/*",),
             calibrated_on=GRIP, looked_for=("channel_delay",), known=(0.08, 0.12)),
    Question("ferrari", "ferrari_250lm/targa66_first_400s.csv", "ferrari_250lm", "ferrari_250lm",
             ("*+1@1[68]0", "*+1@2*"), cut=20.0, calibrated_on=FIRST_LAPS,
             looked_for=("combined_slip", "load_transfer_long", "load_transfer_lat")),
    Question("genesis", "genesis_g80/cpg_slow_lap.csv", "genesis_g80", "genesis_g80", cut=20.0,
             looked_for=("sideslip_bias", "gyro_bias", "steer_gain")),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Config:
    """Ask measured logs of real cars."""

    data: Path = Path("../shared/data")
    """Folder with the recordings."""
    only: tuple[str, ...] = ()
    """Questions to ask; all where left out."""
    out: Path = Path("runs/real-logs")
    """Folder for everything."""


def main(cfg: Config) -> dict[str, Any]:
    """Ask, and tell; returns what was found by question."""
    unknown = sorted(set(cfg.only) - {question.name for question in QUESTIONS})
    if unknown:
        raise BadInput(f"question '{unknown[0]}': choose from {', '.join(question.name for question in QUESTIONS)}.")
    found = {}
    for question in QUESTIONS:
        if not cfg.only or question.name in cfg.only:
            found[question.name] = ask(question, cfg)
            print(told(question, found[question.name]), flush=True)
    text = json.dumps(found, indent=1)
    write_atomically(cfg.out / "real_logs.json", lambda path: path.write_text(text, encoding="utf-8"))
    picture(found).savefig(cfg.out / "real_logs.png", dpi=130)
    return found


def ask(question: Question, cfg: Config) -> dict[str, Any]:
    """What the diagnosis says; one made already is read."""
    out = cfg.out / question.name
    plant, car = driven_on(question, cfg), nominal(question, cfg)
    if not (out / "diagnosis.json").is_file():
        flags = ["--columns", question.columns, "--vehicle", str(car), "--out", str(out)]
        flags += ["--runs", *question.runs] if question.runs else []
        flags += ["--cut", str(question.cut)] if question.cut else []
        flags += ["--closed-loop", str(plant)] if plant else []
        run(["diagnose", str(cfg.data / question.log), *flags])
    diagnosis = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    return {key: diagnosis[key] for key in ("verdict", "sentence", "causes", "gain", "closed_loop")} | {
        "answer": answer(question, diagnosis, {one.effect: one.value for one in load_vehicle(car).effects})
    }


def driven_on(question: Question, cfg: Config) -> Path | None:
    """The car found by the question that this one's models are driven on; raises `BadInput` where it was not asked."""
    if question.plant is None:
        return None
    car = cfg.out / question.plant / "extended.yaml"
    if not car.is_file():
        raise BadInput(f"question '{question.name}' drives on the car that '{question.plant}' finds; ask that one too.")
    return car


def nominal(question: Question, cfg: Config) -> Path:
    """The car that the question begins with: the file's, or one calibrated on other runs."""
    if question.calibrated_on is None:
        return Path(question.vehicle)
    log, runs, effects, columns, cut = question.calibrated_on
    folder = cfg.out / f"{question.vehicle}_calibrated"
    if not (folder / "calibrated.yaml").is_file():
        flags = ["--columns", columns, "--vehicle", question.vehicle, "--out", str(folder)]
        flags += ["--cut", str(cut)] if cut else []
        run(["calibrate", str(cfg.data / log), *flags, "--runs", *runs, "--effects", *effects])
    if not question.forgotten:
        return folder / "calibrated.yaml"
    car = yaml.safe_load((folder / "calibrated.yaml").read_text(encoding="utf-8"))
    car.pop("covariance", None)
    for effect in question.forgotten:
        del car["effects"][effect]
    path = cfg.out / f"{question.name}_nominal.yaml"
    write_atomically(path, lambda path: path.write_text(yaml.safe_dump(car, sort_keys=False), encoding="utf-8"))
    return path


def run(argv: list[str]) -> None:
    """A verb, which has told by itself what stopped it."""
    print(f"\n$ driftjax {' '.join(argv)}", flush=True)
    if code := driftjax(argv):
        raise SystemExit(code)


def answer(question: Question, diagnosis: dict[str, Any], before: dict[str, float]) -> dict[str, Any]:
    """Values and intervals of what was looked for, and whether each lies where others found it."""
    found = {}
    for cause in diagnosis["causes"]:
        if cause["effect"] not in question.looked_for:
            continue
        for name, parameter in cause["parameters"].items():
            value, interval = parameter["value"], parameter["ci95"]
            if question.relative:
                unit = 1 + before[cause["effect"]]
                value, interval = (1 + value) / unit, [(1 + end) / unit for end in interval]
            inside = None if question.known is None else question.known[0] <= value <= question.known[1]
            found[f"{cause['effect']}.{name}"] = {"value": value, "ci95": interval, "as_known": inside}
    return found


def told(question: Question, found: dict[str, Any]) -> str:
    """One question's result in words."""
    lines = [f"{question.name}: {found['verdict']}; looked for {' or '.join(question.looked_for)}"]
    for name, one in found["answer"].items():
        low, high = one["ci95"]
        known = "" if question.known is None else f"; others: {question.known[0]:g}..{question.known[1]:g}"
        lines.append(f"  {name} = {one['value']:.3g} [{low:.3g}, {high:.3g}]{known}")
    if not found["answer"]:
        lines.append("  none of them was named")
    gain = found["gain"]
    for model in ("extended", "extended_gp") if SECOND in gain["horizons_s"] else ():
        at = gain["horizons_s"].index(SECOND)
        low, high = gain["ratio_ci95"][model][at]
        lines.append(f"  {model}: error after 1 s on runs held out, over that of the nominal car: "
                     f"{gain['ratio'][model][at]:.2f} [{low:.2f}, {high:.2f}]")  # fmt: skip
    if (share := gain["skill"].get("extended")) is not None:
        low, high = gain["ci95"]["extended"]
        lines.append(f"  share of the explainable error removed on runs held out: {share:.2f} [{low:.2f}, {high:.2f}]")
    if (driven := found["closed_loop"]) and driven["difference"]:
        apart = driven["difference"]["lateral_error"]
        laps = [f"{name} {one['completed'][0]} of {one['completed'][1]}" for name, one in driven["models"].items()]
        lines.append(f"  laps completed on the car of {question.plant}: {', '.join(laps)}; lateral error changes by "
                     f"{apart['mean']:.3f} [{apart['ci95'][0]:.3f}, {apart['ci95'][1]:.3f}] m")  # fmt: skip
    return "\n".join(lines)


def picture(found: dict[str, Any]) -> Figure:
    """Errors of every model one second ahead on runs held out, over those of the nominal car."""
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained", sharey=True)
    for axis, (channel, words) in zip(axes, {"V": "speed", "beta": "sideslip", "r": "yaw rate"}.items(), strict=True):
        for place, one in enumerate(found.values()):
            gain = one["gain"]
            if SECOND not in gain["horizons_s"]:
                continue
            at = gain["horizons_s"].index(SECOND)
            models = [name for name in COMPARED if name in gain["rmse"]]
            for k, name in enumerate(models):
                ratio = gain["rmse"][name][channel][at] / gain["rmse"]["nominal"][channel][at]
                axis.bar(place + 0.16 * (k - (len(models) - 1) / 2), ratio, 0.15, color=COMPARED[name][0],
                         label=COMPARED[name][1] if place == 0 else None)  # fmt: skip
        axis.set_xticks(np.arange(len(found)), [name.replace("_", "\n") for name in found], fontsize=8)
        axis.set_yscale("log")
        axis.set_yticks([0.1, 0.2, 0.5, 1, 2, 5], ["0.1", "0.2", "0.5", "1", "2", "5"])
        axis.set_yticks([], minor=True)
        axis.set_title(words)
        axis.axhline(1, color="0.6", lw=0.8)
    axes[0].set_ylabel("error after 1 s on runs held out,\nover that of the nominal car [-]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
    return figure


if __name__ == "__main__":
    main(tyro.cli(Config, prog="python -m experiments.real_logs"))
