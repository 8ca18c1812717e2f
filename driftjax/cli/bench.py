"""`driftjax bench`: speed of each part beside its peers."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import default_out, progress, typed, within
from driftjax.core.config import to_dict
from driftjax.store import RunFolder
from driftjax.studies.bench.config import PARTS, Config
from driftjax.studies.bench.run import main as measure
from driftjax.studies.bench.table import page


@dataclasses.dataclass(frozen=True)
class Bench:
    """Speed of each part, as a ratio against a peer measured in the same run: table, JSON, scaling figures."""

    options: Annotated[Config, tyro.conf.arg(name="")] = Config()
    out: Path | None = None
    """Output folder; runs/bench-PARTS-TIME where left out."""


def run(argv: list[str]) -> int:
    """Measure, write, print."""
    # each part has a process of its own, which finds no memory on a GPU that this one has taken as a whole
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    typed_in = typed(Bench, argv, "driftjax bench")
    options = typed_in.options
    name = "quick" if options.quick else "all" if options.only == PARTS else "-".join(options.only)
    folder = RunFolder.create(typed_in.out or default_out("bench", name), to_dict(options), "bench")
    return within(folder, lambda: work(options, folder))


def work(options: Config, folder: RunFolder) -> int:
    """The results into `folder`."""
    with progress() as report:
        results = measure(options, folder.path, report)
    print(page(results), end="")
    print(f"bench: {folder.path}")
    return 0
