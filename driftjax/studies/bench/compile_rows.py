"""Time that `driftjax learn` spends on tracing, lowering and compiling, with an empty compilation cache and a full one.

One run in this process: `python -m driftjax.studies.bench.compile_rows OUT FOLDER`.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax

from driftjax.core.config import to_dict
from driftjax.learning.config import load_learn_config
from driftjax.learning.run import run
from driftjax.store import RunFolder
from driftjax.studies.bench.config import BenchConfig
from driftjax.studies.bench.rows import PartResult, Row, Timing

TARGET = 45.0  # seconds
EVENTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",  # or what it takes to find the program in the cache
)


class Spans:
    """Record the intervals in which this process traced, lowered or compiled; they may overlap."""

    def __init__(self) -> None:
        self.found: list[tuple[float, float]] = []

    def __call__(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event in EVENTS:
            end = time.perf_counter()
            self.found.append((end - duration_secs, end))

    def seconds(self) -> float:
        """Return the length of the union of the intervals [s]."""
        total, reached = 0.0, 0.0
        for start, end in sorted(self.found):
            total += max(0.0, end - max(start, reached))
            reached = max(reached, end)
        return total


def time_programs(out: Path, folder: Path) -> None:
    """Learn into the run folder `folder`; write the seconds spent on programs, and in all, to `out`."""
    spans = Spans()
    jax.monitoring.register_event_duration_secs_listener(spans)
    start = time.perf_counter()
    config = dataclasses.replace(load_learn_config("sedan"), plants=1)  # one process sees every program once
    run(config, RunFolder.create(folder, to_dict(config)), lambda text, done, total: None)
    seconds = {"programs": spans.seconds(), "all": time.perf_counter() - start, "number": len(spans.found)}
    out.write_text(json.dumps(seconds), encoding="utf-8")


def run_learn(folder: Path, name: str) -> dict[str, float]:
    """Run `driftjax learn` with the cache in `folder`; returns the seconds spent on programs, and in total."""
    out = folder / f"{name}.json"
    command = [sys.executable, "-m", "driftjax.studies.bench.compile_rows", str(out), str(folder / name)]
    own = {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run(command, env={**os.environ, **own}, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"learning ended with code {done.returncode}: {done.stderr.strip()[-2000:]}")
    return json.loads(out.read_text(encoding="utf-8"))


def measure_rows(cfg: BenchConfig) -> PartResult:
    """Measure one row, once: it takes minutes."""
    del cfg
    with tempfile.TemporaryDirectory(prefix="driftjax-bench-") as folder:
        empty, full = run_learn(Path(folder), "empty"), run_learn(Path(folder), "full")
    words = f"the whole run of one plant in one process: {empty['all']:.3g} s, then {full['all']:.3g} s"
    facts = {"empty": empty, "full": full, "remarks": words}
    return PartResult([Row("compile", "driftjax learn: tracing, lowering, compiling, with an empty cache", "run",
                         Timing((empty["programs"],)), "the same with a full cache", Timing((full["programs"],)),
                         "seconds", TARGET, facts=facts)])  # fmt: skip


if __name__ == "__main__":
    time_programs(Path(sys.argv[1]), Path(sys.argv[2]))
