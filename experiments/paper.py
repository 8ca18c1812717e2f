"""Tables and figures of the paper's comparison: `python -m experiments.paper` (`--help`: options)."""

import sys
from pathlib import Path
from typing import Annotated

import tyro

import driftjax as dj
from driftjax.studies.paper.config import PaperConfig
from driftjax.studies.paper.run import run_comparison
from driftjax.studies.paper.table import paper_page


def compare(
    options: Annotated[PaperConfig, tyro.conf.arg(name="")], out: Path = Path("runs/paper"), workers: int = 0
) -> None:
    """Drive the runs that the folder `out` lacks, with `workers` processes, and print the tables."""
    report = lambda text, done, total: print(f"{done}/{total} {text}", flush=True)
    print(paper_page(run_comparison(options, out, report, workers)), end="")


if __name__ == "__main__":
    try:
        tyro.cli(compare, prog="python -m experiments.paper")
    except dj.BadInput as error:
        sys.exit(f"paper: {error}")
