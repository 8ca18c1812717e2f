"""Run cases in parallel, writing each result to disk as soon as it is available."""

import json
import sys
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

from driftjax.core.config import to_dict
from driftjax.parallel import process_executor
from driftjax.studies.hidden_effects.case import Case
from driftjax.studies.hidden_effects.trial import run_case


def try_case(case: Case) -> dict[str, Any]:
    """Return the result of a case, or its error, which counts as a failure."""
    try:
        return run_case(case)
    except Exception:
        return {"case": to_dict(case), "group": case.group, "error": traceback.format_exc()}


def read_results(path: Path) -> list[dict[str, Any]]:
    """Read the results so far."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.is_file() else []


def run_all(cases: list[Case], path: Path, num: int) -> list[dict[str, Any]]:
    """Return the results of all `cases`: those in the file `path`, and those of `num` processes, which are appended."""
    known = read_results(path)
    done = {json.dumps(result["case"]) for result in known}
    todo = [case for case in cases if case.line() not in done]
    start = time.monotonic()
    with path.open("a", encoding="utf-8") as file:
        for i, result in enumerate(_run_missing(todo, num), start=1):
            file.write(json.dumps(result) + "\n")
            file.flush()
            known.append(result)
            left = (time.monotonic() - start) / i * (len(todo) - i) / 60
            print(f"{i}/{len(todo)}, {left:.0f} min left: {format_result(result)}", file=sys.stderr, flush=True)
    return known


def _run_missing(cases: list[Case], num: int) -> Iterator[dict[str, Any]]:
    with process_executor(num if num > 1 else 0) as executor:
        if executor.pool is None:
            yield from map(try_case, cases)
            return
        running = [executor.pool.submit(try_case, case) for case in cases]
        yield from (future.result() for future in as_completed(running))


def format_result(result: dict[str, Any]) -> str:
    """Format a result in one line."""
    hidden = " + ".join(f"{e['name']} {e['strengths']}" for e in result["case"]["effects"]) or "nothing"
    if "error" in result:
        return f"{result['group']}: {hidden} -> failed: {result['error'].strip().splitlines()[-1]}"
    named = ", ".join(f"{c['effect']} {c['probability']:.2f}" for c in result["causes"]) or "-"
    return f"{result['group']}: {hidden} -> {result['verdict']} {named}, {result['seconds']:.0f} s"
