"""Table and figures of the speed of each part against peers: `python -m experiments.bench` (`--help`: options)."""

import os
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.studies.bench.config import BenchConfig
from driftjax.studies.bench.run import run_bench
from driftjax.studies.bench.table import bench_page


def measure(options: Annotated[BenchConfig, tyro.conf.arg(name="")], out: Path = Path("runs/bench")) -> None:
    """Write results.json, results.md and figures to the folder `out`, and print the table."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # each part is a process that shares the GPU
    print(
        bench_page(run_bench(options, out, lambda text, done, total: print(f"{done}/{total} {text}", flush=True))),
        end="",
    )


if __name__ == "__main__":
    tyro.cli(measure, prog="python -m experiments.bench")
