"""`driftjax diagnose`: model errors that measured logs show, and the gain of correcting them."""

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated, Literal

import tyro

from driftjax.cli.console import by_steps, default_out, parse, print_notes, progress, run_in
from driftjax.core import require
from driftjax.diagnosis.diagnose import Diagnosis, diagnose, diagnose_settings
from driftjax.diagnosis.held_out import DiagnoseConfig
from driftjax.diagnosis.resolve import resolved_log
from driftjax.logs import Log, read_log
from driftjax.report import closed_loop_table, error_share_table, gain_table, parity_statement, write_diagnosis
from driftjax.store import RunFolder
from driftjax.studies.closed_loop import ClosedLoopCase, add_closed_loop, load_case
from driftjax.vehicle import VehicleConfig, load_vehicle, unmodelled_effects

STEPS = {"noise and nominal car": 25, "naming": 60, "gain": 10, "show": 5, "done": 0}


@dataclasses.dataclass(frozen=True)
class DiagnoseOptions:
    """Show and name the errors of a simulation from measured logs: diagnosis.json, extended.yaml, report.html."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """CSV, Parquet or MATLAB files in the log format (t, V, beta, r, delta, Fxr and, where known, run, psi, s); with
    `--columns` in any other, and the recordings of ROS, MCAP, MDF, MoTeC, AiM, CarMaker and RaceLogic."""
    options: Annotated[DiagnoseConfig, tyro.conf.arg(name="")] = DiagnoseConfig()
    vehicle: Path = Path("sedan")
    """Nominal car: a shipped name or a vehicle YAML, the extended.yaml of an earlier diagnosis among them: its effects
    are where this one starts."""
    combined_slip: float | None = None
    """Friction ellipse of the nominal car, 0 none (as published), 1 a circle; left out: the vehicle's own [-]."""
    columns: str | None = None
    """Column map of foreign logs: a shipped name or a YAML; left out: the log format."""
    runs: tuple[str, ...] = ()
    """Names of the runs to use, or of parts that `--cut` makes of them (RUN@BEGIN), `*` stands for anything; all where
    left out."""
    cut: float | None = None
    """Length of the parts that long runs are cut into, so that some can be held out; left out: they stay whole [s]."""
    drive: Path | None = None
    """truth.yaml of a simulated car: the manoeuvre proposed is driven on it, and the diagnosis made again with that run
    in the folder `next`."""
    closed_loop: Path | None = None
    """Plant: the truth.yaml of a simulated car, a plant YAML or a shipped plant. The corner of `driftjax learn` is
    driven on it with the nominal and with the extended car as the MPC's model, four laps each; for a sedan or rc."""
    workers: Literal[0, 1] | None = None
    """Processes beside this one: 1 measures the gain in a second one, 0 does all in one; left out, 1 where there are
    two cores and no GPU. The result does not depend on it."""
    out: Path | None = None
    """Output folder; runs/diagnose-CAR-TIME where left out."""


def run(argv: list[str]) -> int:
    """Read, diagnose and print."""
    flags = parse(DiagnoseOptions, argv, "driftjax diagnose")
    no_selection = flags.drive is None or not (flags.columns or flags.runs)
    require(no_selection, "key 'drive': its run has the log format and joins all runs; leave --columns and --runs out.")
    vehicle = load_vehicle(flags.vehicle, flags.combined_slip)
    case = load_case(flags.closed_loop, vehicle) if flags.closed_loop else None
    log = read_log(flags.logs, flags.columns, runs=flags.runs, cut=flags.cut)
    settings = lambda log: diagnose_settings(vehicle, log, flags.options) | {"closed_loop": case.name if case else None}
    folder = RunFolder.create(flags.out or default_out("diagnose", vehicle.name), settings(log), "diagnose")

    def task() -> int:
        diagnosis, last = work(vehicle, log, flags.options, folder, case, flags.workers), folder
        if flags.drive and diagnosis.proposal:
            longer = diagnosis.drive_proposal(flags.drive, folder.path / "next.csv", cut=flags.cut)
            last = RunFolder.create(folder.path / "next", settings(longer), "diagnose")
            diagnosis = work(vehicle, longer, flags.options, last, case, flags.workers)
        print(f"next: {next_step(diagnosis, last.path)}")
        return 0

    return run_in(folder, task)


def next_step(diagnosis: Diagnosis, folder: Path) -> str:
    """Say what to do after a diagnosis in `folder`: more data where they are needed, else how to use the result."""
    path, car = shlex.quote(str(folder)), shlex.quote(str(folder / "extended.yaml"))
    if diagnosis.evidence is None:
        return "record a longer log and diagnose it; several logs can be given together."
    if proposal := diagnosis.proposal:
        return (f"drive `{proposal.manoeuvre}` for {proposal.duration:g} s and diagnose its log with this one; "
                f"`driftjax play {path}` shows what is known so far.")  # fmt: skip
    use = f"; `driftjax plan --vehicle {car}` plans with the corrected car" if diagnosis.causes else ""
    return f"`driftjax play {path}` shows the measured car beside the predicted one{use}."


def work(
    vehicle: VehicleConfig,
    log: Log,
    config: DiagnoseConfig,
    folder: RunFolder,
    case: ClosedLoopCase | None,
    workers: int | None,
) -> Diagnosis:
    """Diagnose into `folder` and print the result, with closed-loop laps on `case`."""
    log = resolved_log(vehicle, log)
    print_notes(log.notes)
    with progress() as report:
        step = by_steps(report, STEPS)
        diagnosis = diagnose(vehicle, log, config, workers=workers, report=step)
        step("show")
        diagnosis.save(folder.path)
        step("done")
    content = folder.read_json("diagnosis")
    print(f"\n{diagnosis.verdict}: {diagnosis.sentence}\n")
    if table := error_share_table(content):
        print(table)
    if diagnosis.proposal:
        print(diagnosis.proposal.sentence + "\n")
    if content["show"]:
        print(f"{content['show']['worst']}\n{parity_statement(content['show']['kinematic_parity'])}\n")
        print(gain_table(content["gain"]))
    if case and diagnosis.evidence:
        print(f"closed loop: driving on {case.name}", flush=True)
        print_notes(unmodelled_effects(diagnosis.extended))
        print(closed_loop_table(add_closed_loop(folder, case, diagnosis)))
    print(f"report: {write_diagnosis(folder)}")
    return diagnosis
