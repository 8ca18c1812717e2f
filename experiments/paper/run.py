"""Drive every run of the comparison that is not there yet, and put together what they show."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from driftjax.core import BadInput, from_dict
from driftjax.core.config import to_dict
from driftjax.data import RunFolder
from driftjax.learn.config import LearnConfig
from driftjax.learn.run import run as learn
from driftjax.report import write_report
from experiments.paper.arms import ABLATIONS, MAIN, Arm, arms, fingerprint
from experiments.paper.config import Config
from experiments.paper.figures import write_figures
from experiments.paper.statistics import ablation, compared
from experiments.paper.table import page

Report = Callable[[str, int, int], None]


def main(cfg: Config, folder: RunFolder, report: Report, num_workers: int) -> dict[str, Any]:
    """Results of the comparison; each run has a folder of its own and goes on where it stopped."""
    cfg = cfg.reduced() if cfg.quick else cfg
    todo, done, found = arms(cfg), [], {}
    for number, arm in enumerate(todo):
        say = lambda stage, done, of, arm=arm, number=number: report(f"{arm.folder}: {stage}", number, len(todo))
        drive(arm, folder.path, say, num_workers)
        if arm.name == MAIN:
            write_report(run_of(arm, folder.path))
        done.append((arm, shown(arm, folder.path)))
        found = write(cfg, done, folder)  # what is measured is told whatever comes next
    report("done", len(todo), len(todo))
    write_figures(found, folder.path / "figures")
    return found


def rebuild(cfg: Config, folder: RunFolder) -> dict[str, Any]:
    """Results, tables and figures from the runs that are finished."""
    cfg = cfg.reduced() if cfg.quick else cfg
    done = [arm for arm in arms(cfg) if (folder.path / arm.folder / "results.json").exists()]
    if not done or done[0].name != MAIN:
        raise BadInput(f"{folder.path}: its main comparison is not finished; go on with `driftjax paper --resume`.")
    found = write(cfg, [(arm, shown(arm, folder.path)) for arm in done], folder)
    write_figures(found, folder.path / "figures")
    return found


def drive(arm: Arm, out: Path, report: Report, num_workers: int) -> None:
    """The laps of one run, or what is left of them."""
    path = out / arm.folder
    if (path / "config.yaml").exists():
        run = RunFolder.open(path)
        learn_config = from_dict(LearnConfig, run.config, str(path / "config.yaml"))
    else:
        run, learn_config = RunFolder.create(path, to_dict(arm.learn)), arm.learn
    if not run.has("results.json"):
        learn(learn_config, run, report, num_workers)


def run_of(arm: Arm, out: Path) -> RunFolder:
    """The folder of a finished run."""
    return RunFolder.open(out / arm.folder)


def shown(arm: Arm, out: Path) -> dict[str, Any]:
    """What one finished run shows."""
    run = run_of(arm, out)
    if arm.name == MAIN:
        return {"settings": fingerprint(arm), **compared(run, arm.car)}
    return {"words": ABLATIONS[arm.name][0], **ablation(run)}


def write(cfg: Config, done: list[tuple[Arm, dict[str, Any]]], folder: RunFolder) -> dict[str, Any]:
    """results.json and results.md of the runs that are `done`, with what each shows; the former is returned."""
    cars: dict[str, Any] = {}
    for arm, one in done:
        if arm.name == MAIN:
            cars[arm.car] = one | {"ablations": {}}
        elif arm.car in cars:
            cars[arm.car]["ablations"][arm.name] = one
    numbers = [*range(cfg.first_plant, cfg.first_plant + done[0][0].learn.plants)]
    split = {"seed": cfg.seed, "half": cfg.half, "plants": numbers, "noise_seeds": cfg.noise_seeds,
             "development": [0, cfg.plants - 1], "held_out": [cfg.plants, 2 * cfg.plants - 1]}  # fmt: skip
    found = {"options": to_dict(cfg), "split": split, "cars": cars}
    folder.write_json("results", found)
    (folder.path / "results.md").write_text(page(found), encoding="utf-8")
    return found
