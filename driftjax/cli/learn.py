"""`driftjax learn`: run the paper's experiment, or resume one."""

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import default_out, early_flags, parse, print_notes, progress, run_in
from driftjax.core import BadInput, from_dict, read_yaml
from driftjax.core.config import to_dict
from driftjax.learning.config import LearnConfig, complete_learn_config
from driftjax.learning.run import check_files, learn
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle, unmodelled_effects


@dataclasses.dataclass(frozen=True)
class LearnOptions:
    """Plan, nominal laps, GP laps and active exploration, on a batch of plants driven side by side."""

    options: Annotated[LearnConfig, tyro.conf.arg(name="")]
    config: Path | None = None
    """YAML file of options, where they differ from the car's defaults; flags go before it."""
    out: Path | None = None
    """Run folder; runs/learn-CAR-TIME where left out."""
    resume: Path | None = None
    """Run folder to go on with, from its last finished stage and with its own config; no flag beside but --workers."""
    workers: int | None = None
    """Processes that drive side by side; one per core where left out, none on a GPU. Results do not depend on it."""


def run(argv: list[str]) -> int:
    """Plan, drive and print table and report."""
    early, others = early_flags(argv, "car", "config", "resume", "workers")
    num = _positive("workers", early["workers"])
    if early["resume"] and not {"-h", "--help"} & set(others):
        if others or early["car"] or early["config"]:
            raise BadInput("--resume goes on with the run's own config; leave out every flag but --workers.")
        folder = RunFolder.open(early["resume"])
        config = from_dict(LearnConfig, folder.config, str(folder.path / "config.yaml"))
        check_files(config)
    else:
        options = parse(LearnOptions, argv, "driftjax learn", LearnOptions(defaults(early["car"], early["config"])))
        config = options.options
        check_files(config)
        folder = RunFolder.create(options.out or default_out("learn", config.car), to_dict(config))
    resume = f"driftjax learn --resume {shlex.quote(str(folder.path))}"
    return run_in(folder, lambda: work(config, folder, num), resume)


def _positive(flag: str, text: str | None) -> int | None:
    if text is not None and not (text.isdecimal() and int(text) > 0):
        raise BadInput(f"--{flag} is '{text}'; give a whole number of at least 1.")
    return None if text is None else int(text)


def defaults(car: str | None, file: str | None) -> LearnConfig:
    """Return the options of the YAML `file`, completed by the shipped ones of `car`, else of the car that it names."""
    written = read_yaml(Path(file)) if file else {}
    return complete_learn_config(written | ({"car": car} if car else {}), file or "defaults")


def work(config: LearnConfig, folder: RunFolder, workers: int | None) -> int:
    """Run or resume; then write and print the report."""
    from driftjax.report import results_table, write_report

    print(f"run folder: {folder.path}", flush=True)
    print_notes(unmodelled_effects(load_vehicle(config.vehicle)))
    with progress() as report:
        results = learn(config, folder.path, workers=workers, report=report).results
    page = write_report(folder)
    print(results_table(results))
    print(f"report: {page}")
    path = shlex.quote(str(folder.path))
    print(f"next: see the laps with `driftjax play {path}`; try other options with `driftjax sweep`.")
    return 0
