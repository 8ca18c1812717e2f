"""`driftjax learn` in this process with its compilations timed: `python -m driftjax.studies.bench.compiling OUT FLAG...`."""

import json
import sys
import time
from pathlib import Path

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


def main(out: Path, flags: list[str]) -> int:
    """Learn; seconds spent on programs, and in all, go to `out`."""
    from driftjax.cli.front import main as driftjax
    from driftjax.cli.front import set_up_jax

    set_up_jax()
    import jax

    spans = Spans()
    jax.monitoring.register_event_duration_secs_listener(spans)
    start = time.perf_counter()
    code = driftjax(["learn", *flags])
    found = {"programs": spans.seconds(), "all": time.perf_counter() - start, "number": len(spans.found)}
    out.write_text(json.dumps(found), encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
