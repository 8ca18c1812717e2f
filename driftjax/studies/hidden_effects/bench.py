"""Run the whole bench: draw, run, score, report."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from driftjax.core import BadInput, write_text
from driftjax.manoeuvres.library import RICH
from driftjax.studies.hidden_effects.case import Case, read_case
from driftjax.studies.hidden_effects.case_runner import run_all
from driftjax.studies.hidden_effects.criteria import confusions
from driftjax.studies.hidden_effects.draw import CaseNumbers, draw_cases
from driftjax.studies.hidden_effects.figures import write_figures
from driftjax.studies.hidden_effects.score import as_json, as_text, score_results
from driftjax.studies.hidden_effects.trial import run_case

CASES, RESULTS = "cases.jsonl", "results.jsonl"


@dataclass(frozen=True)
class StudyConfig:
    """Hide effects in cars and see what `diagnose` makes of the logs."""

    numbers: Annotated[CaseNumbers, tyro.conf.arg(name="")] = field(default_factory=CaseNumbers)
    cars: tuple[str, ...] = ("sedan",)
    """Shipped cars, each with all these cases."""
    manoeuvres: tuple[str, ...] = RICH
    """Runs of 10 s of each case; every third is held out."""
    seed: int | None = None
    """Of the draw; a fresh one, which is printed, where left out."""
    workers: int = 2
    """Processes; each takes a core and 2 GB."""
    case: str | None = None
    """Run only this case, a line of JSON as printed, and print its result."""
    resume: bool = False
    """Go on with the cases in `out` that have no result yet."""
    out: Path = Path("runs/hidden-effects")
    """Folder for cases, results, scores and figures."""


def run_study(cfg: StudyConfig) -> dict[str, Any]:
    """Run the bench; return its scores, or the result of the one case given."""
    if cfg.case is not None:
        result = run_case(read_case(cfg.case))
        print(json.dumps(result, indent=1))
        return result
    results = run_all(_cases(cfg), cfg.out / RESULTS, cfg.workers)
    return report_scores(results, cfg.out)


def _cases(cfg: StudyConfig) -> list[Case]:
    """Draw new cases and write them, or read those of an interrupted bench."""
    path = cfg.out / CASES
    if cfg.resume:
        if not path.is_file():
            raise BadInput(f"{path}: no such file; there is no bench to go on with.")
        return [read_case(line) for line in path.read_text(encoding="utf-8").splitlines()]
    if path.exists():
        raise BadInput(f"{path}: exists already; give another folder (--out), or continue with --resume.")
    seed = int(np.random.SeedSequence().generate_state(1)[0]) if cfg.seed is None else cfg.seed
    cases = draw_cases(cfg.numbers, cfg.cars, seed, manoeuvres=cfg.manoeuvres)
    print(f"{len(cases)} cases of seed {seed}", flush=True)
    cfg.out.mkdir(parents=True, exist_ok=True)
    text = "".join(case.line() + "\n" for case in cases)
    write_text(path, text)
    return cases


def report_scores(results: list[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Print scores and wrong cases; write score.json and figures."""
    table = score_results(results)
    wrong = confusions(results)
    scores = as_json(table)
    write_text(out / "score.json", json.dumps(scores, indent=1))
    print("\n".join(["", as_text(table), "", f"{len(wrong)} cases went wrong:", *wrong]))
    print("\n".join(f"figure: {path}" for path in write_figures(results, out)))
    return scores
