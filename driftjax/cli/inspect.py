"""`driftjax inspect`: content of a log and agreement of its channels."""

import dataclasses
from pathlib import Path

import tyro

from driftjax.cli.console import default_out, log_flags, parse, print_notes, run_in
from driftjax.core import require
from driftjax.logs import Guess, guess_columns, inspect, read_log
from driftjax.report import write_inspection
from driftjax.store import RunFolder
from driftjax.vehicle import VehicleConfig, load_vehicle

UNKNOWN_CAR = "YOUR_CAR.yaml"  # stands in commands for the file of a car that was not given


@dataclasses.dataclass(frozen=True)
class InspectOptions:
    """What is in a log: channels with ranges and gaps, rates, and whether the channels agree with each other."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Logs, as for `driftjax diagnose`."""
    columns: str | None = None
    """Column map of foreign logs: a shipped name or a YAML; left out: the log format."""
    vehicle: Path | None = None
    """Vehicle whose wheelbase the yaw rate is compared by: a shipped name or a vehicle YAML; left out: it is not. With
    `--guess` it tells a steering wheel from a road wheel."""
    guess: bool = False
    """Propose a column map for a single log instead: which column is which channel, in which unit, how certain."""
    write: Path | None = None
    """With `--guess`: file that the proposed column map is written to."""
    out: Path | None = None
    """Output folder; runs/inspect-LOG-TIME where left out."""


def run(argv: list[str]) -> int:
    """Read, compare and print."""
    flags = parse(InspectOptions, argv, "driftjax inspect")
    vehicle = load_vehicle(flags.vehicle) if flags.vehicle else None
    require(flags.guess or flags.write is None, "flag '--write' writes what '--guess' proposes; give that too.")
    if flags.guess:
        return propose(flags, vehicle)
    log = read_log(flags.logs, flags.columns)
    options = {"logs": [str(path) for path in flags.logs], "columns": flags.columns,
               "vehicle": str(flags.vehicle) if flags.vehicle else None}  # fmt: skip
    folder = RunFolder.create(flags.out or default_out("inspect", flags.logs[0].stem), options, "inspect")

    def work() -> int:
        inspection = inspect(log, vehicle.a + vehicle.b if vehicle else None)
        folder.write_json("inspection", inspection.content())
        print_notes(log.notes)
        print(inspection)
        for path in write_inspection(log.runs, folder.path):
            print(f"figure: {path}")
        again = log_flags(flags.logs, flags.columns, flags.vehicle or UNKNOWN_CAR)
        print("next: a slope near -1 is a wrong sign, near 57.3 or 3.6 a wrong unit, near 0 another quantity; where "
              f"there is none, `driftjax diagnose {again}` says what the simulated car lacks.")  # fmt: skip
        return 0

    return run_in(folder, work)


def propose(flags: InspectOptions, vehicle: VehicleConfig | None) -> int:
    """Print a column map for the log and write it where `--write` says."""
    require(len(flags.logs) == 1 and flags.columns is None and flags.out is None,
            "flag '--guess' is for one log; leave out --columns and --out.")  # fmt: skip
    guess = guess_columns(flags.logs[0], wheelbase=vehicle.a + vehicle.b if vehicle else None)
    print(guess)
    if flags.write is None:
        print(f"\n{guess.yaml()}", end="")
    else:
        guess.write(flags.write)
        print(f"\nmap: {flags.write}")
    print(f"next: {next_step(flags, guess)}")
    return 0


def next_step(flags: InspectOptions, guess: Guess) -> str:
    """Say what to do with a proposed column map."""
    if flags.write is None:
        return "look it over; `--write map.yaml` writes it to a file."
    if (lacks := guess.lacks()) is not None:
        return f"write in {flags.write} which column is '{lacks}'; without that no log is read."
    again = log_flags(flags.logs, str(flags.write), flags.vehicle or UNKNOWN_CAR)
    return f"look the map over; `driftjax inspect {again}` shows whether the log is read right with it."
