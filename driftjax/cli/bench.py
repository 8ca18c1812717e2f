"""`driftjax bench`: speed of each part beside its peers."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import default_out, parse, progress, run_in
from driftjax.core.config import to_dict
from driftjax.store import RunFolder
from driftjax.studies.bench.config import PARTS, BenchConfig
from driftjax.studies.bench.run import run_bench
from driftjax.studies.bench.table import bench_page


@dataclasses.dataclass(frozen=True)
class BenchOptions:
    """Speed of each part, as a ratio against a peer measured in the same run: table, JSON, scaling figures."""

    options: Annotated[BenchConfig, tyro.conf.arg(name="")] = BenchConfig()
    out: Path | None = None
    """Output folder; runs/bench-PARTS-TIME where left out."""


def run(argv: list[str]) -> int:
    """Measure, write and print the table."""
    # each part has a process of its own, which needs memory on the same GPU
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    flags = parse(BenchOptions, argv, "driftjax bench")
    options = flags.options
    name = "quick" if options.quick else "all" if options.only == PARTS else "-".join(options.only)
    folder = RunFolder.create(flags.out or default_out("bench", name), to_dict(options), "bench")

    def work() -> int:
        with progress() as report:
            print(bench_page(run_bench(options, folder.path, report)), end="")
        print(f"next: see {folder.path}; compare ratios of runs, not times of machines.")
        return 0

    return run_in(folder, work)
