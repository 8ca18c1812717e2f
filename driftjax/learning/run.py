"""Run `driftjax learn`: the paper's experiment from the first lap to the results, resumable after every stage."""

import io
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import xarray as xr

from driftjax.core import BadInput, from_dict
from driftjax.core.config import to_dict
from driftjax.core.progress import ProgressReport
from driftjax.environment import require_float64
from driftjax.learning.compile_ahead import compile_stages
from driftjax.learning.config import LearnConfig, load_learn_config
from driftjax.learning.results import results
from driftjax.learning.scenario import Scenario, build_scenario
from driftjax.learning.stages import drive_stage, first_progress, stage_names
from driftjax.learning.updates import Progress
from driftjax.parallel import num_workers as useful_workers
from driftjax.parallel import process_executor
from driftjax.planner import load_plan_config
from driftjax.planner.dataset import plan_dataset
from driftjax.sim import load_plants
from driftjax.sim.sensors import load_sensors
from driftjax.store.folder import RunFolder
from driftjax.track import check_width, load_track
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.plants import load_distribution

ONCE = {"plan": 6, "compile": 16}  # usual time of a first run, in that of a stage; less where the programs are stored


def learn(
    config: LearnConfig | str = "sedan",
    out: str | Path = "runs/learn",
    *,
    workers: int | None = None,
    report: ProgressReport = lambda text, done, total: None,
) -> RunFolder:
    """Run the paper's experiment: plan, nominal laps, GP laps and active exploration, on a batch of plants.

    `config` may be the name of a shipped car (sedan, rc). Stages already in `out` are not driven again, so that a
    stopped run continues; `workers` processes drive in parallel, one per core if omitted, none on a GPU. `report(text,
    done, total)` is called at every stage. Returns the run folder, with `.results` and `.laps`. Raises `BadInput` for
    files that do not fit, and where `out` holds a run with another config.
    """
    require_float64()  # before a folder is made
    config = load_learn_config(config) if isinstance(config, str) else config
    check_files(config)
    folder = RunFolder.ensure(out, to_dict(config), "learn")
    if from_dict(LearnConfig, folder.config, str(folder.path / "config.yaml")) != config:
        raise BadInput(f"{out}: holds a run with another config; give another folder.")
    num = useful_workers(config.batch_size) if workers is None else workers
    run(config, folder, report, num if num > 1 else 0)
    return folder


def check_files(config: LearnConfig) -> None:
    """Read every file that `config` names; raises `BadInput` before anything is written."""
    vehicle, track = load_vehicle(config.vehicle), load_track(config.track)
    check_width(track, vehicle.width, str(config.track))
    load_plan_config(config.plan, config.car)
    load_sensors(config.sensors)
    load_plants(config.plant)
    if not config.plant:
        load_distribution(config.distribution)


def run(config: LearnConfig, folder: RunFolder, report: ProgressReport, num_workers: int = 0) -> dict[str, Any]:
    """Drive every stage missing in `folder`; write and return the results, and collect the laps.

    Deterministic on one machine: a config gives the same laps, resumed or not, with any number of worker processes.
    """
    require_float64()
    names = stage_names(config)
    share = _share_done(len(names), report)
    share("plan: compile, solve", len(folder.finished()))
    with process_executor(num_workers, fused=True) as executor:
        scenario = build_scenario(config, executor)
        if not folder.has("plan.nc"):
            folder.write_dataset("plan.nc", plan_dataset(scenario.plan, scenario.track, config.car))
        progress, done = _resume(scenario, folder)
        say = lambda name: share(f"compile: {name}", len(done) + ONCE["plan"])
        compile_stages(scenario, [name for name in names if name not in done], say)
        seen = {name.partition("-")[0] for name in names} if executor.pool else set[str]()  # kinds that are compiled
        before_stage = lambda name: share(_stage_text(name, seen), names.index(name) + sum(ONCE.values()))
        for name, data, after in drive_stages(scenario, progress, done, before_stage):
            folder.write_stage(name, data, _dump(after))
    summary = results(scenario, {name: folder.read_stage(name) for name in folder.finished()})
    folder.write_json("results", summary)
    folder.write_laps()
    share("done", len(names) + sum(ONCE.values()))
    return summary


def _share_done(num_stages: int, report: ProgressReport) -> Callable[[str, float], None]:
    """Return `share(text, parts)`, which reports finished parts in percent: a stage is one, `ONCE` has the others."""
    total = num_stages + sum(ONCE.values())
    return lambda text, parts: report(text, round(100 * parts / total), 100)


def _stage_text(name: str, seen: set[str]) -> str:
    """Return the progress text of a stage that starts, and add its kind to `seen`, the kinds that are compiled."""
    kind = name.partition("-")[0]
    text = name if kind in seen else f"{name}: compile, drive"
    seen.add(kind)
    return text


def drive_stages(
    scenario: Scenario, progress: Progress, done: Collection[str] = (), before_stage: Callable[[str], object] = str
) -> Iterator[tuple[str, xr.Dataset, Progress]]:
    """Yield name, laps and progress of every stage not in `done`; `before_stage` is called before each of these."""
    for index, name in enumerate(stage_names(scenario.config)):
        if name in done:
            continue
        before_stage(name)
        if (driven := drive_stage(scenario, progress, name, index)) is not None:
            progress, data = driven
            yield name, data, progress


def _dump(progress: Progress) -> bytes:
    stream = io.BytesIO()
    eqx.tree_serialise_leaves(stream, progress)
    return stream.getvalue()


def read_progress(scenario: Scenario, folder: RunFolder, name: str) -> Progress:
    """Read the progress after the stage `name`."""
    try:
        return eqx.tree_deserialise_leaves(io.BytesIO(folder.read_state(name)), first_progress(scenario))
    except (RuntimeError, ValueError, EOFError) as error:
        words = str(error).splitlines()[0]
        raise BadInput(f"{folder.path}: the state of stage {name} cannot be read ({words}); start a new run.") from None


def _resume(scenario: Scenario, folder: RunFolder) -> tuple[Progress, list[str]]:
    done = folder.finished()
    if not done:
        return first_progress(scenario), done
    if "lateral_error_measured" not in folder.read_stage(done[-1]):
        raise BadInput(f"{folder.path}: its laps were judged by their true lateral error, which is no longer done; "
                       "start a new run.")  # fmt: skip
    return read_progress(scenario, folder, done[-1]), done
