"""`driftjax calibrate`: the nominal car fitted to runs in which it should be right, before others are asked."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import tyro
import yaml

from driftjax.cli.console import default_out, typed, within
from driftjax.core import require, write_atomically
from driftjax.diagnosis.calibrate import Calibration, calibrate
from driftjax.diagnosis.diagnose import check_held_out
from driftjax.diagnosis.serialise import extended_car, gain_json
from driftjax.logs import read_log
from driftjax.report import gain_table
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import effects_named

USUAL = ("friction", "stiffness_front", "stiffness_rear", "drive_gain", "steer_offset")


@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Fit effects that the nominal car is believed to have, such as its friction: calibrated.yaml.

    Nothing is tested here: what should be found by `driftjax diagnose` later is to be left out.
    """

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Logs, as for `driftjax diagnose`."""
    vehicle: Path = Path("sedan")
    """Nominal car: a shipped name or a vehicle YAML."""
    combined_slip: float | None = None
    """Friction ellipse of the nominal car, 0 none (as published), 1 a circle; left out: the vehicle's own [-]."""
    columns: str | None = None
    """Column map of foreign logs: a shipped name or a YAML; left out: the log format."""
    runs: tuple[str, ...] = ()
    """Names of the runs to use, or of parts that `--cut` makes of them (RUN@BEGIN), `*` stands for anything; all where
    left out."""
    cut: float | None = None
    """Length of the parts that long runs are cut into, so that some can be held out; left out: they stay whole [s]."""
    effects: tuple[str, ...] = USUAL
    """Effects of the catalogue to fit."""
    held_out: int = 3
    """Every so-many-th run is held out to measure the gain on, by a fit without them; 0: none."""
    out: Path | None = None
    """Output folder; runs/calibrate-CAR-TIME where left out."""

    def __post_init__(self) -> None:
        check_held_out(self.held_out)
        require(bool(self.effects), "key 'effects' is empty; name the effects to fit.")
        effects_named(self.effects)


def run(argv: list[str]) -> int:
    """Read, fit, tell."""
    asked = typed(Calibrate, argv, "driftjax calibrate")
    vehicle = load_vehicle(asked.vehicle, asked.combined_slip)
    log = read_log(asked.logs, asked.columns, runs=asked.runs, cut=asked.cut)
    options = {"vehicle": dataclasses.asdict(vehicle), "logs": [str(path) for path in asked.logs]}
    options |= {"columns": asked.columns, "runs": list(asked.runs), "cut": asked.cut, "effects": list(asked.effects)}
    folder = RunFolder.create(
        asked.out or default_out("calibrate", vehicle.name), options | {"held_out": asked.held_out}, "calibrate"
    )

    def work() -> int:
        for note in log.notes:
            print(f"note: {note}")
        found = calibrate(vehicle, log.runs, asked.effects, asked.held_out)
        car = extended_car(vehicle, found.task, found.members, found.fit.theta, found.scores)
        text = yaml.safe_dump(car, sort_keys=False)
        write_atomically(folder.path / "calibrated.yaml", lambda path: path.write_text(text, encoding="utf-8"))
        folder.write_json("calibration", content(found))
        print(told(found))
        print(gain_table(folder.read_json("calibration")["gain"]))
        print(f"car: {folder.path / 'calibrated.yaml'}")
        return 0

    return within(folder, work)


def content(found: Calibration) -> dict[str, Any]:
    """`calibration.json`."""
    noise = found.task.noise
    return {
        "parameters": [
            {"parameter": name, "value": value, "ci95_half": half, "unit": unit, "at_bound": name in found.bound}
            for name, value, half, unit in rows(found)
        ],
        "gain": gain_json(found.gain),
        "noise": {"measurement": noise.sigma.tolist(), "process": noise.disturbance.tolist(),
                  "correlation_s": noise.correlation},
    }  # fmt: skip


def rows(found: Calibration) -> list[tuple[str, float, float, str]]:
    """Name, value, half-width of its 95 % interval and unit of every parameter fitted, SI."""
    task = found.task
    columns, scale = task.columns(found.members), np.asarray(task.model.scale)
    each = [(task.effects[i].name, p) for i in found.members for p in task.effects[i].parameters]
    values, widths = found.fit.theta[columns] * scale[columns], found.half_width * scale[columns]
    return [
        (f"{name}.{p.name}", float(value), float(width), p.unit)
        for (name, p), value, width in zip(each, values, widths, strict=True)
    ]


def told(found: Calibration) -> str:
    """The table on the screen."""
    lines = [f"{'parameter':28}{'value':>12}{'':3}{'95 %':>9}"]
    for name, value, half, unit in rows(found):
        end = "   on its bound: these data ask for more" if name in found.bound else ""
        lines.append(f"{name:28}{value:12.4g} ± {half:9.2g} {'' if unit == '1' else unit}{end}".rstrip())
    return "\n".join(lines) + "\n"
