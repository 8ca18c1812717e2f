"""`driftjax export`: a car in the format of another tool, and what that format loses of it."""

import dataclasses
from pathlib import Path

import tyro

from driftjax.cli.console import default_out, parse, print_notes, run_in
from driftjax.export import export_car, require_format
from driftjax.logs import read_log
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Write a car, with the effects that a diagnosis found, in the format of another tool.

    export.json and the output say which effects the format cannot hold, and what the car predicts worse without them.
    """

    car: tyro.conf.Positional[Path]
    """Car: a shipped name or a vehicle YAML, such as the extended.yaml of a diagnosis."""
    to: str
    """Format: race_stack, tum, f1tenth_gym, commonroad, autoware, open_car_dynamics or casadi."""
    log: tuple[Path, ...] = ()
    """Logs on which the loss is measured; left out: a standard manoeuvre."""
    columns: str | None = None
    """Column map of foreign logs: a shipped name or a YAML; left out: the log format."""
    runs: tuple[str, ...] = ()
    """Names of the runs of the logs to use, `*` stands for anything; all where left out."""
    top_speed: float | None = None
    """Top speed that tables and limits reach; left out: 9 sqrt(g L), 49 m/s for a sedan [m/s]."""
    dt: float = 0.02
    """Sample time of the CasADi step [s]."""
    out: Path | None = None
    """Output folder; runs/export-CAR-TIME where left out."""


def run(argv: list[str]) -> int:
    """Write the files and print what they lack."""
    flags = parse(ExportOptions, argv, "driftjax export")
    require_format(flags.to)
    vehicle = load_vehicle(flags.car)
    log = read_log(flags.log, flags.columns, runs=flags.runs) if flags.log else None
    options = {key: str(value) if isinstance(value, Path) else value for key, value in vars(flags).items()}
    options |= {"log": [str(path) for path in flags.log], "runs": list(flags.runs)}
    folder = RunFolder.create(flags.out or default_out("export", vehicle.name), options, "export")

    def work() -> int:
        export = export_car(vehicle, flags.to, folder.path, log=log, top_speed=flags.top_speed, dt=flags.dt)
        print_notes(log.notes if log else ())
        print(export)
        print(f"next: the files for the other tool are in {folder.path}, with export.json on what they lose.")
        return 0

    return run_in(folder, work)
