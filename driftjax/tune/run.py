"""Run `driftjax tune`: both searches on the training plants, then one lap each on the held-out plants."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from driftjax.core.config import to_dict
from driftjax.core.progress import ProgressReport
from driftjax.environment import require_float64
from driftjax.learning.metrics import interval
from driftjax.learning.run import check_files
from driftjax.learning.scenario import build_scenario
from driftjax.parallel import num_workers as useful_workers
from driftjax.parallel import process_executor
from driftjax.store.folder import RunFolder
from driftjax.tune.config import TuneConfig, complete_tune_config
from driftjax.tune.laps import LapEvaluator, LapResults, lap_outcome
from driftjax.tune.parameters import NAMES, parameter_values
from driftjax.tune.search import Search, descend, random_search

KINDS = ("default", "tuned", "random")
PAIRS = (("default", "tuned"), ("default", "random"), ("random", "tuned"))


def tune_mpc(
    config: TuneConfig | str = "sedan",
    out: str | Path = "runs/tune",
    *,
    workers: int | None = None,
    report: ProgressReport = lambda text, done, total: None,
) -> RunFolder:
    """Search weights and lead of the drift MPC by gradients through laps, and at random; judge on other plants.

    `config` may be the name of a shipped car (sedan, rc); `workers` processes drive in parallel, one per core if
    omitted, none on a GPU. `report(text, done, total)` is called at every step. Returns the run folder with `.results`.
    Raises `BadInput` for files that do not fit, and where `out` holds a run with other options.
    """
    require_float64()
    config = complete_tune_config({}, "defaults", config) if isinstance(config, str) else config
    check_files(config.learn)
    folder = RunFolder.resume(out, to_dict(config), "tune")
    num = useful_workers(config.training * config.budget) if workers is None else workers
    search_and_judge(config, folder, report, num if num > 1 else 0)
    return folder


def search_and_judge(
    config: TuneConfig, folder: RunFolder, report: ProgressReport, num_workers: int = 0
) -> dict[str, Any]:
    """Search, evaluate, write `results.json`; return it. Deterministic except for the seconds."""
    report("plan", 0, 4)
    num = config.training + config.held_out
    learn = dataclasses.replace(config.learn.nothing_learnt, plants=num, controllers=("path",), noise_seeds=1)
    with process_executor(num_workers, fused=True) as executor:
        evaluator = LapEvaluator(config, build_scenario(learn, executor))
        searches = run_searches(evaluator, report)
        report("laps of held-out plants", 3, 4)
        points = np.stack([searches[kind]["p"] for kind in KINDS])
        results = results_content(evaluator, searches, evaluator.drive(points, slice(config.training, num)))
    folder.write_json("results", results)
    report("done", 4, 4)
    return results


def run_searches(evaluator: LapEvaluator, report: ProgressReport) -> dict[str, dict[str, Any]]:
    """Return the three settings: the start, and the result of each search on the training plants."""
    config, notes = evaluator.config, {"failed_laps": 0, "laps_without_slope": 0, "slopes": 0, "slope_seconds": 0.0}
    training, box = slice(0, config.training), config.box

    def evaluate(points: np.ndarray) -> np.ndarray:
        driven = evaluator.drive(points, training)
        notes["failed_laps"] += int(np.sum(~driven.figures.completed))
        return driven.loss.mean(axis=1)

    def slope(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        begun = time.monotonic()
        laps = evaluator.gradients(p, training)
        notes["laps_without_slope"] += int(np.sum(~laps.valid))
        notes["slopes"] += 1
        notes["slope_seconds"] += time.monotonic() - begun
        return np.asarray(laps.gradient).mean(axis=0), np.asarray(laps.gauss).mean(axis=0)

    def timed(search: Callable[[], Search]) -> dict[str, Any]:
        notes.update(dict.fromkeys(notes, 0))
        begun = time.monotonic()
        result = search()
        return result._asdict() | {"seconds": time.monotonic() - begun} | notes

    report("gradients through laps", 1, 4)
    tuned = timed(lambda: descend(evaluate, slope, box, config.budget))
    report("random search", 2, 4)
    random = timed(lambda: random_search(evaluate, box, config.budget, config.learn.seed))
    first = {"p": np.zeros(len(box)), "loss": tuned["history"][0][1], "cost": 0}
    return {"default": first, "tuned": tuned, "random": random}


def results_content(evaluator: LapEvaluator, searches: dict[str, dict[str, Any]], driven: LapResults) -> dict[str, Any]:
    """Return the content of `results.json`."""
    config, names = evaluator.config, evaluator.plants
    error = np.asarray(driven.figures.lateral_error)
    settings = {
        kind: one
        | {
            "p": dict(zip(NAMES, one["p"].tolist(), strict=True)),
            "values": parameter_values(evaluator.untuned_drivers, one["p"]),
        }
        for kind, one in searches.items()
    }
    per_plant = [
        {
            "plant": name,
            "loss": dict(zip(KINDS, driven.loss[:, i].tolist(), strict=True)),
            "lateral_error": dict(zip(KINDS, error[:, i].tolist(), strict=True)),
            "drift_share": dict(zip(KINDS, driven.figures.drift_share[:, i].tolist(), strict=True)),
            "ended": {kind: lap_outcome(driven.code[k, i]) for k, kind in enumerate(KINDS)},
        }
        for i, name in enumerate(names[config.training :])
    ]
    row = {kind: i for i, kind in enumerate(KINDS)}
    apart = lambda values: {f"{b} - {a}": interval(values[row[b]] - values[row[a]]) for a, b in PAIRS}
    return {
        "parameters": list(NAMES),
        "box": dict(zip(NAMES, np.exp(config.box).tolist(), strict=True)),
        "training_plants": names[: config.training],
        "settings": settings,
        "held_out": {
            "plants": per_plant,
            "loss": {kind: interval(driven.loss[row[kind]]) for kind in KINDS},
            "lateral_error": {kind: interval(error[row[kind]]) for kind in KINDS},
            "completed": {kind: int(np.sum(driven.figures.completed[row[kind]])) for kind in KINDS},
            "loss_difference": apart(driven.loss),
            "loss_lower_on": {f"{b} - {a}": int(np.sum(driven.loss[row[b]] < driven.loss[row[a]])) for a, b in PAIRS},
            "lateral_error_difference": apart(error),
        },
    }
