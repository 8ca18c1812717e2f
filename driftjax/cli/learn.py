"""`driftjax learn`: the paper's experiment, or the rest of one that was stopped."""

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import default_out, peek, progress, tell, typed, within
from driftjax.core import BadInput, from_dict, merged, read_yaml
from driftjax.core.config import to_dict
from driftjax.learning.config import LearnConfig, load_learn_config
from driftjax.parallel import num_workers
from driftjax.planner import load_plan_config
from driftjax.sim import load_plants
from driftjax.sim.sensors import load_sensors
from driftjax.store import RunFolder
from driftjax.track import check_width, load_track
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.plants import load_distribution


@dataclasses.dataclass(frozen=True)
class Learn:
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
    """Plan, laps, table, figures."""
    early, others = peek(argv, "car", "config", "resume", "workers")
    num = _positive("workers", early["workers"])
    if early["resume"] and not {"-h", "--help"} & set(others):
        if others or early["car"] or early["config"]:
            raise BadInput("--resume goes on with the run's own config; leave out every flag but --workers.")
        folder = RunFolder.open(early["resume"])
        config = from_dict(LearnConfig, folder.config, str(folder.path / "config.yaml"))
        check(config)
    else:
        options = typed(Learn, argv, "driftjax learn", Learn(defaults(early["car"], early["config"])))
        config = options.options
        check(config)
        folder = RunFolder.create(options.out or default_out("learn", config.car), to_dict(config))
    resume = f"driftjax learn --resume {shlex.quote(str(folder.path))}"
    return within(folder, lambda: work(config, folder, num), resume)


def _positive(flag: str, text: str | None) -> int | None:
    if text is not None and not (text.isdecimal() and int(text) > 0):
        raise BadInput(f"--{flag} is '{text}'; give a whole number of at least 1.")
    return None if text is None else int(text)


def defaults(car: str | None, file: str | None) -> LearnConfig:
    """The car's shipped options with those of the YAML `file` put in."""
    written = read_yaml(Path(file)) if file else {}
    base = to_dict(load_learn_config(car or str(written.get("car", "sedan"))))
    return from_dict(LearnConfig, merged(base, written), file or "defaults")


def check(config: LearnConfig) -> None:
    """Read every file that `config` names, so that bad ones are told at once and nothing is left behind."""
    vehicle, track = load_vehicle(config.vehicle), load_track(config.track)
    check_width(track, vehicle.width, str(config.track))
    load_plan_config(config.plan)
    load_sensors(config.sensors)
    load_plants(config.plant)
    if not config.plant:
        load_distribution(config.car)


def work(config: LearnConfig, folder: RunFolder, workers: int | None) -> int:
    """Run, or go on; then write and print what came out."""
    from driftjax.learning.run import run as learn
    from driftjax.report import table, write_report

    print(f"run folder: {folder.path}", flush=True)
    tell(load_vehicle(config.vehicle))
    with progress() as report:
        num = num_workers(config.num_lanes) if workers is None else workers
        results = learn(config, folder, report, num if num > 1 else 0)
    page = write_report(folder)
    print(table(results))
    print(f"report: {page}")
    return 0
