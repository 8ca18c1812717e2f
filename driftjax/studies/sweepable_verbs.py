"""Verbs that a sweep can run: how their options are completed, and their results as rows."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from driftjax.core import BadInput, find_config, from_dict, require
from driftjax.core.config import to_dict
from driftjax.core.progress import ProgressReport
from driftjax.diagnosis.diagnose import diagnose
from driftjax.diagnosis.held_out import DiagnoseConfig
from driftjax.learning.config import LearnConfig, complete_learn_config, files_of, load_learn_config
from driftjax.learning.run import drive_stages
from driftjax.learning.scenario import Route, build_scenario, route_of
from driftjax.learning.stages import first_progress
from driftjax.logs import read_log
from driftjax.logs.recording import recording_files
from driftjax.parallel import BatchExecutor
from driftjax.store import RunFolder
from driftjax.store.lap_rows import LAP_COLUMNS, lap_rows
from driftjax.studies.paper.config import PaperConfig
from driftjax.sweep import OpenSweep, SweepConfig, SweepResult, Work, check, finish_sweep, load_sweep, open_sweep
from driftjax.sweep.trial import TrialRow
from driftjax.vehicle import load_vehicle

VerbOptions = dict[str, Any]


def complete_learn(options: VerbOptions) -> VerbOptions:
    """Complete options of `learn` with the car's shipped ones."""
    return to_dict(complete_learn_config(options, "a trial"))


def learn_files(config: VerbOptions) -> list[Path]:
    """Return the files that `learn` reads."""
    return list(files_of(from_dict(LearnConfig, config, "a trial")).values())


_routes: dict[str, Route] = {}  # of this process, by what they were made from: trials seldom differ in it
ROUTE = ("vehicle", "combined_slip", "track", "plan", "drift_beta")


def learn_rows(config: VerbOptions, executor: BatchExecutor, folder: Path) -> Iterator[list[TrialRow]]:
    """Yield the laps of every stage."""
    options = from_dict(LearnConfig, config, "a trial")
    made_from = json.dumps([config["gp"]["effects"], *(config[name] for name in ROUTE)])
    if made_from not in _routes:
        _routes[made_from] = route_of(options)
    scenario = build_scenario(options, executor, _routes[made_from])
    for name, data, _ in drive_stages(scenario, first_progress(scenario)):
        yield lap_rows(name, data)


@dataclass(frozen=True)
class LogConfig:
    """Logs and options of a diagnosis, as those of `driftjax diagnose`."""

    logs: tuple[Path, ...]
    vehicle: Path = Path("sedan")
    combined_slip: float | None = None
    columns: str | None = None
    runs: tuple[str, ...] = ()
    cut: float | None = None
    options: DiagnoseConfig = field(default_factory=DiagnoseConfig)


def complete_diagnose(options: VerbOptions) -> VerbOptions:
    """Complete options of `diagnose`."""
    return to_dict(from_dict(LogConfig, options, "a trial"))


def diagnose_files(config: VerbOptions) -> list[Path]:
    """Return the logs, the vehicle's YAML and, where one is given, the column map's; shipped ones among them."""
    columns = [find_config("columns", config["columns"])] if config["columns"] else []
    logs = [file for path in map(Path, config["logs"]) for file in ([path] if path.is_dir() else recording_files(path))]
    return [*logs, find_config("vehicle", config["vehicle"]), *columns]


def diagnose_rows(config: VerbOptions, executor: BatchExecutor, folder: Path) -> Iterator[list[TrialRow]]:
    """Yield the verdict, and the gain on held-out runs."""
    options = from_dict(LogConfig, config, "a trial")
    log = read_log(options.logs, options.columns, runs=options.runs, cut=options.cut)
    content = diagnose(load_vehicle(options.vehicle, options.combined_slip), log, options.options).content()
    names, gain = [cause["effect"] for cause in content["causes"]], content["gain"]
    ahead = gain["skill_horizon_s"]
    at = None if ahead is None else gain["horizons_s"].index(ahead)
    ratio, skill = gain.get("ratio", {}).get("extended"), gain.get("skill", {}).get("extended")
    yield [{"verdict": content["verdict"], "named": len(names), "causes": ", ".join(names),
            "error_ratio": ratio[at] if ratio and at is not None else None, "skill": skill}]  # fmt: skip


def complete_paper(options: VerbOptions) -> VerbOptions:
    """Complete options of `paper`."""
    config = from_dict(PaperConfig, options, "a trial")
    require(config.main, "key 'main' is false; the rows of a sweep are those of the main comparison.")
    return to_dict(config)


def paper_files(config: VerbOptions) -> list[Path]:
    """Return the files that the shipped options of the cars name."""
    return [path for car in config["cars"] for path in files_of(load_learn_config(car)).values()]


def paper_rows(config: VerbOptions, executor: BatchExecutor, folder: Path) -> Iterator[list[TrialRow]]:
    """Yield the means of every method of the comparison, whose runs are in `folder` until it is finished."""
    from driftjax.studies.paper.run import run_comparison

    run = RunFolder.ensure(folder, config, "paper")
    results = run_comparison(from_dict(PaperConfig, config, "a trial"), run, lambda *_: None, 0)
    rows: list[TrialRow] = []
    for car, result in results["cars"].items():
        for controller, methods in result["methods"].items():
            for stage, figures in methods.items():
                means = {name: figures[name]["mean"] for name in PAPER_FIGURES}
                rows.append({"car": car, "controller": controller, "stage": stage} | means)
    shutil.rmtree(folder)
    yield rows


def run_sweep(
    config: SweepConfig | str | Path,
    out: str | Path,
    *,
    workers: int | None = None,
    ray: str | None = None,
    hosts: bool = False,
    report: ProgressReport = lambda text, done, total: None,
) -> SweepResult:
    """Run the trials of a sweep that the folder `out` lacks, and analyse all of them.

    `config` may be the path of a YAML. `workers` processes run side by side, one per core if omitted; `ray` is the
    address of a cluster instead; with `hosts` this is one of several processes of a job, each with a share of the
    trials. `report(text, done, total)` is called at every trial. Raises `BadInput` for options that the verb cannot
    take, and where `out` holds another sweep.
    """
    opened = open_verb_sweep(config, out, hosts)
    return finish_sweep(opened, workers=workers, ray=ray, report=report)


def open_verb_sweep(config: SweepConfig | str | Path, out: str | Path, hosts: bool = False) -> OpenSweep:
    """Check a sweep over a verb's options and create or open its folder; nothing runs yet."""
    where = "" if isinstance(config, SweepConfig) else f"{config}: "
    config = config if isinstance(config, SweepConfig) else load_sweep(Path(config))
    work = WORKS[config.verb]
    try:
        check(config, work)
    except BadInput as error:
        raise BadInput(f"{where}{error}") from None
    return open_sweep(config, work, Path(out), hosts)


PAPER_FIGURES = ("lateral_error", "lateral_error_max", "velocity_rmse", "lap_time", "completed", "drifted")
WORKS = {
    "learn": Work(complete_learn, learn_files, learn_rows, LAP_COLUMNS, fused=True),
    "diagnose": Work(
        complete_diagnose, diagnose_files, diagnose_rows,
        {"verdict": str, "named": int, "causes": str, "error_ratio": float, "skill": float},
    ),
    "paper": Work(
        complete_paper, paper_files, paper_rows,
        {"car": str, "controller": str, "stage": str} | dict.fromkeys(PAPER_FIGURES, float), fused=True,
    ),
}  # fmt: skip
