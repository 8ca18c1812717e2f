"""`driftjax calibrate`: fit the nominal car to runs in which it should be right, before a diagnosis."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import by_steps, default_out, log_flags, parse, print_notes, progress, run_in
from driftjax.diagnosis.calibrate import (
    DEFAULT_EFFECTS,
    STAGED_EFFECTS,
    calibrate,
    calibrate_settings,
    effects_to_fit,
)
from driftjax.diagnosis.held_out import check_held_out
from driftjax.diagnosis.resolve import resolved_log
from driftjax.logs import read_log
from driftjax.report import gain_table
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle

STEPS = {"noise and nominal car": 21, "gain": 53, "fit": 25, "what decides each parameter": 1, "done": 0}
FITTED = (
    f"Effects of the catalogue to fit; left out: {', '.join(DEFAULT_EFFECTS)}, and with `--staged` also "
    f"{', '.join(name for name in STAGED_EFFECTS if name not in DEFAULT_EFFECTS)}."
)


@dataclasses.dataclass(frozen=True)
class CalibrateOptions:
    """Fit effects that the nominal car is believed to have, such as its friction: calibrated.yaml.

    Nothing is tested here: leave out effects that `driftjax diagnose` should find later.
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
    effects: Annotated[tuple[str, ...] | None, tyro.conf.arg(help=FITTED)] = None
    staged: bool = False
    """Fit by stages: straight and coasting stretches of the log decide what they can first, then cornering with grip,
    then the limit."""
    held_out: int = 3
    """Every so-many-th run is held out to measure the gain on, by a fit without them; 0: none."""
    out: Path | None = None
    """Output folder; runs/calibrate-CAR-TIME where left out."""

    def __post_init__(self) -> None:
        check_held_out(self.held_out)
        effects_to_fit(self.effects, self.staged)


def run(argv: list[str]) -> int:
    """Read, fit and print."""
    flags = parse(CalibrateOptions, argv, "driftjax calibrate")
    vehicle = load_vehicle(flags.vehicle, flags.combined_slip)
    log = resolved_log(vehicle, read_log(flags.logs, flags.columns, runs=flags.runs, cut=flags.cut))
    effects = effects_to_fit(flags.effects, flags.staged)
    options = calibrate_settings(vehicle, log, effects, flags.staged, flags.held_out)
    folder = RunFolder.create(flags.out or default_out("calibrate", vehicle.name), options, "calibrate")

    def work() -> int:
        print_notes(log.notes)
        with progress() as report:
            step = by_steps(report, STEPS)
            calibration = calibrate(
                vehicle, log, flags.effects, staged=flags.staged, held_out=flags.held_out, report=step
            )
            calibration.save(folder.path)
            step("done")
        print(f"\n{calibration}")
        print(gain_table(folder.read_json("calibration")["gain"]))
        print(f"car: {folder.path / 'calibrated.yaml'}")
        print(f"next: {next_step(flags, folder.path / 'calibrated.yaml')}")
        return 0

    return run_in(folder, work)


def next_step(flags: CalibrateOptions, car: Path) -> str:
    """Say how to use the calibrated `car`: as the nominal one of a diagnosis of other runs."""
    command = f"driftjax diagnose {log_flags(flags.logs, flags.columns, car)} --runs ..."
    return f"`{command}`, with the runs in which the car may have changed, says what this car lacks in them."
