"""`driftjax compare`: what differs between two logs of like manoeuvres, and the gap that it makes."""

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import by_steps, default_out, parse, print_notes, progress, run_in
from driftjax.diagnosis.compare import CompareConfig, check_alike, compare, compare_settings
from driftjax.diagnosis.resolve import resolved_log
from driftjax.diagnosis.verdict import Verdict
from driftjax.logs import read_log
from driftjax.report import comparison_text, write_comparison
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle

NEXT = {
    Verdict.NOTHING: "these logs show no difference that a parameter of the car would make; harder manoeuvres may.",
    Verdict.NAMED: "`driftjax play {path}` shows the gap; look on the car, or in the simulator, at what is named.",
    Verdict.SET: "record in both cars a manoeuvre in which the rivals above differ, and compare again.",
    Verdict.UNKNOWN: "diagnose each log (`driftjax diagnose`): what is left of the gap is no effect of the catalogue.",
    Verdict.DATA_INSUFFICIENT: "record longer logs, with stronger steering and drive, of the same manoeuvres.",
}
STEPS = {"noise and naming": 72, "differences": 8, "gap": 20, "done": 0}


@dataclasses.dataclass(frozen=True)
class CompareOptions:
    """Name what differs between two logs of like manoeuvres, and the gap that it makes: compare.json, report.html.

    For example of a real car and a simulator of it, on a wet and a dry road, before and after a repair.
    """

    a: tyro.conf.Positional[Path]
    """First log, as for `driftjax diagnose`."""
    b: tyro.conf.Positional[Path]
    """Second log; it may be the same file with other runs, by `--runs-a` and `--runs-b`."""
    options: Annotated[CompareConfig, tyro.conf.arg(name="")] = CompareConfig()
    vehicle: Path = Path("sedan")
    """Nominal car: a shipped name or a vehicle YAML."""
    combined_slip: float | None = None
    """Friction ellipse of the nominal car, 0 none (as published), 1 a circle; left out: the vehicle's own [-]."""
    columns_a: str | None = None
    """Column map of A: a shipped name or a YAML; left out: the log format."""
    columns_b: str | None = None
    """Column map of B; left out: the log format."""
    runs_a: tuple[str, ...] = ()
    """Names of the runs of A to use, or of parts that `--cut` makes of them (RUN@BEGIN), `*` stands for anything; all
    where left out."""
    runs_b: tuple[str, ...] = ()
    """The same of B."""
    cut: float | None = None
    """Length of the parts that long runs are cut into, so that some can be held out; left out: they stay whole [s]."""
    out: Path | None = None
    """Output folder; runs/compare-CAR-TIME where left out."""


def run(argv: list[str]) -> int:
    """Read, compare and print."""
    flags = parse(CompareOptions, argv, "driftjax compare")
    vehicle = load_vehicle(flags.vehicle, flags.combined_slip)
    log_a = read_log(flags.a, flags.columns_a, runs=flags.runs_a, cut=flags.cut)
    log_b = read_log(flags.b, flags.columns_b, runs=flags.runs_b, cut=flags.cut)
    check_alike(log_a, log_b)
    log_a, log_b = (resolved_log(vehicle, log) for log in (log_a, log_b))
    options = compare_settings(vehicle, (log_a, log_b), flags.options)
    folder = RunFolder.create(flags.out or default_out("compare", vehicle.name), options, "compare")

    def work() -> int:
        print_notes(f"{name}: {note}" for name, log in (("A", log_a), ("B", log_b)) for note in log.notes)
        with progress() as report:
            step = by_steps(report, STEPS)
            comparison = compare(vehicle, log_a, log_b, flags.options, report=step)
            comparison.save(folder.path)
            step("done")
        print(f"\n{comparison.verdict}: {comparison.sentence}\n")
        if tables := comparison_text(folder.read_json("compare")):
            print(tables)
        print(f"report: {write_comparison(folder)}")
        print(f"next: {NEXT[comparison.verdict].format(path=shlex.quote(str(folder.path)))}")
        return 0

    return run_in(folder, work)
