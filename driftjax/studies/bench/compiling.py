"""Learn on one plant with all compilations timed: `python -m driftjax.studies.bench.compiling OUT FOLDER`."""

import dataclasses
import json
import sys
import time
from pathlib import Path

import jax

from driftjax.core.config import to_dict
from driftjax.learning.config import load_learn_config
from driftjax.learning.run import run
from driftjax.store import RunFolder

EVENTS = (
    "/jax/core/compile/jaxpr_trace_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",  # or what it takes to find the program in the cache
)


class Spans:
    """When this process traced, lowered or compiled; one may lie within another."""

    def __init__(self) -> None:
        self.found: list[tuple[float, float]] = []

    def __call__(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event in EVENTS:
            end = time.perf_counter()
            self.found.append((end - duration_secs, end))

    def seconds(self) -> float:
        """Length of their union."""
        total, reached = 0.0, 0.0
        for start, end in sorted(self.found):
            total += max(0.0, end - max(start, reached))
            reached = max(reached, end)
        return total


def main(out: Path, folder: Path) -> None:
    """Learn into the run folder `folder`; write the seconds spent on programs, and in all, to `out`."""
    spans = Spans()
    jax.monitoring.register_event_duration_secs_listener(spans)
    start = time.perf_counter()
    config = dataclasses.replace(load_learn_config("sedan"), plants=1)  # one process sees every program once
    run(config, RunFolder.create(folder, to_dict(config)), lambda text, done, total: None)
    seconds = {"programs": spans.seconds(), "all": time.perf_counter() - start, "number": len(spans.found)}
    out.write_text(json.dumps(seconds), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
