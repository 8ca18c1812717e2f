"""How much friction do five recordings of an F1TENTH car have, which knows neither sideslip nor drive force?

`python -m experiments.friction_maps --data FOLDER` with a copy of AhmadAmine998/FrictionMaps fits the shipped car to
each recording by itself, diagnoses it with `--diagnose`, and writes `friction_maps.json` and `friction_maps.md`.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import driftjax as dj

RECORDINGS = ("DS1", "DS2", "DS3", "DS4", "DS5")
DELAY = 0.12  # s of the steering, to start from: what `driftjax inspect` prints for DS5
EFFECTS = ("friction", "stiffness_front", "stiffness_rear", "steer_delay", "steer_lag", "steer_gain", "steer_offset")
HEAD = """| recording | parts, s | 99 % of ay [m/s^2] | friction | it is | steering delay, lag [s] | verdict |
|---|---|---|---|---|---|---|
"""


@dataclasses.dataclass(frozen=True)
class Config:
    """Fit, and diagnose, recordings of an F1TENTH car."""

    data: Path = Path("FrictionMaps")
    """Copy of the repository."""
    only: tuple[str, ...] = RECORDINGS
    """Recordings."""
    diagnose: bool = False
    """Diagnose each recording, too."""
    cut: float = 10.0
    """Length of the parts of a recording [s]."""
    out: Path = Path("runs/friction-maps")
    """Folder for results; recordings that it holds are not fitted again."""


def main(cfg: Config) -> dict[str, Any]:
    """Fit the recordings and write the results after each."""
    if unknown := sorted(set(cfg.only) - set(RECORDINGS)):
        raise dj.BadInput(f"recording '{unknown[0]}': choose from {', '.join(RECORDINGS)}.")
    cfg.out.mkdir(parents=True, exist_ok=True)
    path = cfg.out / "friction_maps.json"
    results = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    for name in cfg.only:
        log = dj.read_log(cfg.data / "DataSets" / name, "f1tenth_frictionmaps", cut=cfg.cut)
        if name not in results:
            results[name] = fitted(log)
        if cfg.diagnose and "refused" not in results[name] and "verdict" not in results[name]:
            results[name] |= diagnosed(log, cfg.out / name)
        path.write_text(json.dumps(results, indent=1), encoding="utf-8")
        path.with_suffix(".md").write_text(table(results), encoding="utf-8")
        print(name, results[name], flush=True)
    print(table(results))
    return results


def nominal_car() -> dj.VehicleConfig:
    """Return the shipped car with a steering delay, without which its observer loses the car."""
    return dj.with_effects(dj.load_vehicle("f1tenth"), {"steer_delay": {"d": DELAY}})


def fitted(log: dj.Log) -> dict[str, Any]:
    """Return the content of the log and the parameters fitted to it with their intervals, or why it was refused."""
    lateral = np.concatenate([np.abs(run.extra["ay"]) for run in log.runs])
    content = {
        "parts": len(log.runs),
        "seconds": sum(len(run.t) * run.dt for run in log.runs),
        "lateral_acceleration": float(np.nanquantile(lateral, 0.99)),
    }
    try:
        calibration = dj.calibrate(nominal_car(), log, EFFECTS, held_out=0)
    except dj.BadInput as error:
        return content | {"refused": str(error)}
    parameters = {one.parameter: one._asdict() for one in calibration.parameters}
    return content | {"lost_s": calibration.lost_s, "parameters": parameters}


def diagnosed(log: dj.Log, folder: Path) -> dict[str, Any]:
    """Return the verdict on the log."""
    diagnosis = dj.diagnose(nominal_car(), log, dj.DiagnoseConfig(gp=False))
    diagnosis.save(folder)
    return {
        "verdict": str(diagnosis.verdict),
        "sentence": diagnosis.sentence,
        "named": [one.effect for one in diagnosis.causes],
    }


def table(results: dict[str, Any]) -> str:
    """Return the results as a Markdown table, with the friction coefficient of the tyres."""
    mu = dj.load_vehicle("f1tenth").mu
    lines = []
    for name, one in sorted(results.items()):
        content = [name, f"{one['parts']}, {one['seconds']:.0f}", f"{one['lateral_acceleration']:.1f}"]
        if "refused" in one:
            lines.append(f"| {' | '.join([*content, one['refused'], '-', '-', '-'])} |")
            continue
        friction = one["parameters"]["friction.p"]
        marks = [word for word in ("dead", "flat", "at_bound") if friction[word]]
        value, half = mu * (1 + friction["value"]), mu * friction["ci95_half"]
        timing = ", ".join(f"{one['parameters'][key]['value']:.3f}" for key in names_of(one, ("delay", "lag")))
        verdict = f"{one['verdict']}: {', '.join(one['named']) or 'nothing'}" if "verdict" in one else "-"
        cells = [*content, f"{value:.2f} +- {half:.2f}", ", ".join(marks) or "decided", timing, verdict]
        lines.append(f"| {' | '.join(cells)} |")
    return HEAD + "\n".join(lines) + "\n"


def names_of(one: dict[str, Any], words: Sequence[str]) -> list[str]:
    """Return the parameters of the steering effects that end in `words`."""
    return [name for word in words for name in one["parameters"] if name.startswith(f"steer_{word}.")]


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, prog="python -m experiments.friction_maps"))
    except dj.BadInput as error:
        sys.exit(f"friction_maps: {error}")
