"""`driftjax plan`: minimum-time plan of one car on one track."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import default_out, early_flags, parse, print_notes, run_in
from driftjax.core import RESULTS, read_yaml
from driftjax.core.config import to_dict
from driftjax.planner import PlanConfig
from driftjax.planner import plan as solve
from driftjax.planner.config import complete_plan_config
from driftjax.report import save_plan
from driftjax.store import RunFolder
from driftjax.track import Track, check_width, load_track
from driftjax.vehicle import VehicleConfig, load_vehicle, unmodelled_effects


@dataclasses.dataclass(frozen=True)
class PlanOptions:
    """Minimum-time plan of a car along a track: plan.nc, plan.csv and figures."""

    options: Annotated[PlanConfig, tyro.conf.arg(name="")]
    vehicle: Path
    """Car: a shipped name or a vehicle YAML, such as the extended.yaml of a diagnosis."""
    track: Path
    """Track: a shipped name, a track YAML or a CSV of x,y,w_right,w_left."""
    car: str = "sedan"
    """Name of the car whose shipped vehicle, track and options are the defaults: sedan or rc."""
    config: Path | None = None
    """YAML file of options, and vehicle and track, where they differ from the car's defaults."""
    out: Path | None = None
    """Output folder; runs/plan-CAR-TIME where left out."""


def run(argv: list[str]) -> int:
    """Plan, write and draw."""
    early, _ = early_flags(argv, "car", "config")
    default = defaults(early["car"], early["config"])
    flags = parse(PlanOptions, argv, "driftjax plan", default)
    vehicle, track = load_vehicle(flags.vehicle), load_track(flags.track)
    check_width(track, vehicle.width, str(flags.track))
    options = {"vehicle": str(flags.vehicle), "track": str(flags.track)} | to_dict(flags.options)
    folder = RunFolder.create(flags.out or default_out("plan", flags.car), options, "plan")
    print_notes(unmodelled_effects(vehicle))
    print(f"planning {vehicle.name} on {flags.track}", flush=True)
    return run_in(folder, lambda: work(vehicle, track, flags.options, folder))


def defaults(car: str | None, file: str | None) -> PlanOptions:
    """Return the options of the YAML `file`, completed by the shipped ones of `car`, else of the car that it names."""
    written = read_yaml(Path(file)) if file else {}
    car = car or str(written.get("car", "sedan"))
    vehicle, track = (Path(str(written.pop(key, name))) for key, name in (("vehicle", car), ("track", f"{car}_corner")))
    return PlanOptions(complete_plan_config(written | {"car": car}, file or "defaults"), vehicle, track, car)


def work(vehicle: VehicleConfig, track: Track, options: PlanConfig, folder: RunFolder) -> int:
    """Plan into `folder`; returns 1 if the plan is not valid."""
    plan = solve(track, vehicle, options)
    save_plan(plan, track, vehicle, folder.path)
    print(f"lap time {float(plan.lap_time):.3f} s after {int(plan.num_steps)} iterations", end=", ")
    print(f"optimality {float(plan.kkt):.1e}, violation {float(plan.violation):.1e}")
    print("drift: " + (", ".join(f"{a:.4g} to {b:.4g} m" for a, b in plan.drift_intervals()) or "none"))
    print(f"plan: {folder.path}")
    if plan.result == RESULTS.successful:
        print(f"next: see {folder.path / 'plan_trajectory.png'}; `driftjax learn` drives such a plan.")
        return 0
    print(f"driftjax plan: {RESULTS[plan.result]}", file=sys.stderr)
    return 1
