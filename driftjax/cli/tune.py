"""`driftjax tune`: weights and switching lead by gradients through closed-loop laps, against random search."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import default_out, early_flags, parse, progress, run_in
from driftjax.core import read_yaml, require_at_least
from driftjax.core.config import to_dict
from driftjax.learning.run import check_files
from driftjax.store import RunFolder
from driftjax.tune.config import QUICK, TuneConfig, complete_tune_config


@dataclasses.dataclass(frozen=True)
class TuneOptions:
    """Q, R and switching lead of the drift MPC by gradients through closed-loop laps, judged on plants held out."""

    options: Annotated[TuneConfig, tyro.conf.arg(name="")]
    car: str = "sedan"
    """Name of the car whose shipped settings of `driftjax learn` are the defaults: sedan or rc."""
    quick: bool = False
    """One training plant, two held out and one step: shows that it runs, and measures nothing."""
    config: Path | None = None
    """YAML file of options, where they differ from the car's defaults."""
    out: Path | None = None
    """Run folder; runs/tune-CAR-TIME where left out."""
    workers: int | None = None
    """Processes that drive side by side; one per core where left out, none on a GPU. Results do not depend on it."""

    def __post_init__(self) -> None:
        require_at_least(self, 1, "workers")


def run(argv: list[str]) -> int:
    """Search, evaluate and print."""
    early, _ = early_flags(argv, "car", "config")
    default = TuneOptions(defaults(early["car"], early["config"], "--quick" in argv))
    flags = parse(TuneOptions, argv, "driftjax tune", default)
    config = flags.options
    check_files(config.learn)
    folder = RunFolder.create(flags.out or default_out("tune", config.learn.car), to_dict(config), "tune")
    return run_in(folder, lambda: work(config, folder, flags.workers))


def defaults(car: str | None, file: str | None, quick: bool) -> TuneConfig:
    """Return the options of the YAML `file`, completed by QUICK where `quick`, and by the shipped ones."""
    written = (QUICK if quick else {}) | (read_yaml(Path(file)) if file else {})
    return complete_tune_config(written, file or "defaults", car)


def work(config: TuneConfig, folder: RunFolder, workers: int | None) -> int:
    """Run; then write and print the results."""
    from driftjax.report import tuning_summary, write_tuning
    from driftjax.tune.run import tune_mpc

    print(f"run folder: {folder.path}", flush=True)
    with progress() as report:
        results = tune_mpc(config, folder.path, workers=workers, report=report).results
    print(tuning_summary(results))
    print(f"report: {write_tuning(folder)}")
    print(f"next: see {folder.path / 'figures'}; `driftjax learn` takes such values as --path.Q and --switch.lead.")
    return 0
