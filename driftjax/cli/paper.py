"""`driftjax paper`: the paper's comparison on both cars, with statistics over plants, beside the paper's numbers."""

import dataclasses
import shlex
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import default_out, early_flags, parse, progress, run_in
from driftjax.core import BadInput, from_dict, require_at_least
from driftjax.core.config import to_dict
from driftjax.parallel import num_workers
from driftjax.store import RunFolder
from driftjax.studies.paper.config import PaperConfig


@dataclasses.dataclass(frozen=True)
class PaperOptions:
    """Every method of the paper side by side on plants held out, with ablations: tables, figures, run folders."""

    options: Annotated[PaperConfig, tyro.conf.arg(name="")] = PaperConfig()
    out: Path | None = None
    """Output folder; runs/paper-HALF-TIME where left out."""
    resume: Path | None = None
    """Folder to go on with, from the last finished stage of its last run; no flag beside but --workers."""
    workers: int | None = None
    """Processes that drive side by side; one per core where left out, none on a GPU. Results do not depend on it."""

    def __post_init__(self) -> None:
        require_at_least(self, 1, "workers")


def run(argv: list[str]) -> int:
    """Drive the missing runs; write tables and figures."""
    _, others = early_flags(argv, "resume", "workers")
    flags = parse(PaperOptions, argv, "driftjax paper")
    if flags.resume:
        if others:
            raise BadInput("--resume goes on with the folder's own options; leave out every flag but --workers.")
        folder = RunFolder.open(flags.resume)
        if folder.verb != "paper":
            raise BadInput(f"{folder.path}: a run of `driftjax {folder.verb}`, not of `driftjax paper`.")
        options = from_dict(PaperConfig, folder.config, str(folder.path / "config.yaml"))
    else:
        options = flags.options
        out = flags.out or default_out("paper", "quick" if options.quick else options.half)
        folder = RunFolder.create(out, to_dict(options), "paper")
    again = f"driftjax paper --resume {shlex.quote(str(folder.path))}"
    return run_in(folder, lambda: work(options, folder, flags.workers), again)


def work(options: PaperConfig, folder: RunFolder, workers: int | None) -> int:
    """Run the comparison into `folder` and print its tables."""
    from driftjax.studies.paper.arms import arms
    from driftjax.studies.paper.run import run_comparison
    from driftjax.studies.paper.table import paper_page

    print(f"run folder: {folder.path}", flush=True)
    with progress() as report:
        num = num_workers(options.plants) if workers is None else workers
        results = run_comparison(options, folder, report, num if num > 1 else 0)
    print(paper_page(results), end="")
    print(f"paper: {folder.path}")
    first = folder.path / arms(options)[0].folder
    print(f"next: see {folder.path / 'figures'}; `driftjax play {shlex.quote(str(first))}` shows the laps.")
    return 0
