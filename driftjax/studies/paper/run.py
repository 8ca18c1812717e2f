"""Drive every missing run of the comparison, and summarise the results."""

import dataclasses
from itertools import takewhile
from pathlib import Path
from typing import Any

from driftjax.core import BadInput, from_dict
from driftjax.core.config import to_dict
from driftjax.core.progress import ProgressReport
from driftjax.learning.config import LearnConfig
from driftjax.learning.run import run as learn
from driftjax.report import write_report
from driftjax.store import RunFolder
from driftjax.store.files import read_json
from driftjax.studies.paper.ablations import ABLATIONS
from driftjax.studies.paper.arms import EXTENDED, GPR_BEST, MAIN, Arm, arms, settings_hash
from driftjax.studies.paper.config import PaperConfig
from driftjax.studies.paper.credit import credit
from driftjax.studies.paper.exploration import CHOOSERS, best_so_far, compare_choosers
from driftjax.studies.paper.extended import CAR, JSON, extend
from driftjax.studies.paper.feasible import feasible
from driftjax.studies.paper.figures import write_figures
from driftjax.studies.paper.statistics import ablation_results, compare_methods
from driftjax.studies.paper.table import paper_page
from driftjax.vehicle import load_vehicle

DIAGNOSIS = "diagnosis"  # folder below that of the car


def run_comparison(
    cfg: PaperConfig, folder: RunFolder | Path, report: ProgressReport, num_workers: int
) -> dict[str, Any]:
    """Run the comparison in `folder` and return its results; each run in it resumes where it stopped."""
    folder = folder if isinstance(folder, RunFolder) else RunFolder.resume(folder, to_dict(cfg), "paper")
    cfg = cfg.reduced() if cfg.quick else cfg
    todo, done, results = arms(cfg), [], {}
    for number, arm in enumerate(todo):
        say = lambda stage, done, of, arm=arm, number=number: report(
            f"{arm.folder}: {stage}", round(number + done / of, 2), len(todo)
        )
        drive_arm(arm, folder.path, say, num_workers)
        if arm.name == MAIN:
            write_report(open_arm(arm, folder.path))
        done.append((arm, arm_results(arm, folder.path)))
        results = write_results(cfg, done, folder)  # written after every run, whatever happens next
    report("done", len(todo), len(todo))
    write_figures(results, folder.path / "figures")
    return results


def rebuild(cfg: PaperConfig, folder: RunFolder) -> dict[str, Any]:
    """Rebuild results, tables and figures from the finished runs."""
    cfg = cfg.reduced() if cfg.quick else cfg
    done = [arm for arm in arms(cfg) if (folder.path / arm.folder / "results.json").exists()]
    if not done or (cfg.main and done[0].name != MAIN):
        first = "main comparison" if cfg.main else "first ablation"
        raise BadInput(f"{folder.path}: its {first} is not finished; go on with `driftjax paper --resume`.")
    results = write_results(cfg, [(arm, arm_results(arm, folder.path)) for arm in done], folder)
    write_figures(results, folder.path / "figures")
    return results


def drive_arm(arm: Arm, out: Path, report: ProgressReport, num_workers: int) -> None:
    """Drive the missing laps of one run."""
    path = out / arm.folder
    run = RunFolder.open(path) if (path / "config.yaml").exists() else start_run(arm, out, report)
    if not run.has("results.json"):
        learn(from_dict(LearnConfig, run.config, str(path / "config.yaml")), run, report, num_workers)


def start_run(arm: Arm, out: Path, report: ProgressReport) -> RunFolder:
    """Create a run folder, with the laps that another run has driven already."""
    config = arm.learn
    if arm.name == EXTENDED:
        config = dataclasses.replace(config, vehicle=extended_vehicle(arm, out, report))
    run = RunFolder.create(out / arm.folder, to_dict(config))
    if arm.like:
        other = RunFolder.open(out / arm.like)
        for name in takewhile(lambda name: name != GPR_BEST, other.finished()):
            run.write_stage(name, other.read_stage(name), other.read_state(name))
    return run


def extended_vehicle(arm: Arm, out: Path, report: ProgressReport) -> Path:
    """Return the YAML of the car extended by a diagnosis, creating it if missing."""
    folder = out / arm.car / DIAGNOSIS
    if not (folder / CAR).exists():
        nominal = load_vehicle(arm.learn.vehicle).with_combined_slip(arm.learn.combined_slip)
        extend(arm.car, nominal, folder, lambda text: report(f"diagnosis, {text}", 0, 1))
    return (folder / CAR).resolve()


def open_arm(arm: Arm, out: Path) -> RunFolder:
    """Open the folder of a finished run."""
    return RunFolder.open(out / arm.folder)


def arm_results(arm: Arm, out: Path) -> dict[str, Any]:
    """Return the results of one finished run."""
    run = open_arm(arm, out)
    if arm.name == MAIN:
        return {"settings": settings_hash(arm), **compare_methods(run, arm.car), "feasible": feasible(run)}
    results = {"words": ABLATIONS[arm.name][0], **ablation_results(run)}
    if arm.name in CHOOSERS:
        results["best_so_far"] = {who: best_so_far(run, who).tolist() for who in arm.learn.controllers}
    if arm.name == EXTENDED:
        diagnosis = read_json(out / arm.car / DIAGNOSIS / JSON)
        results["diagnosis"] = {key: diagnosis[key] for key in ("verdict", "sentence")}
    return results


def write_results(cfg: PaperConfig, done: list[tuple[Arm, dict[str, Any]]], folder: RunFolder) -> dict[str, Any]:
    """Write results.json and results.md of the runs in `done`; return the former."""
    cars: dict[str, Any] = {}
    for arm, one in done:
        car = cars.setdefault(arm.car, {"ablations": {}})
        if arm.name == MAIN:
            car |= one
        else:
            car["ablations"][arm.name] = one
    for car in cars.values():
        car["credit"] = credit(car["ablations"])
        car["choosers"] = compare_choosers(car["ablations"])
    first = done[0][0].learn
    numbers = [*range(cfg.first_plant, cfg.first_plant + first.plants)]
    split = {"seed": cfg.seed, "half": cfg.half, "plants": numbers, "noise_seeds": first.noise_seeds,
             "development": [0, cfg.plants - 1], "held_out": [cfg.plants, 2 * cfg.plants - 1]}  # fmt: skip
    results = {"options": to_dict(cfg), "split": split, "cars": cars}
    folder.write_json("results", results)
    (folder.path / "results.md").write_text(paper_page(results), encoding="utf-8")
    return results
