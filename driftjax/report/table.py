"""Format results as text: the table at the end of a run, and one line per run."""

import math
from collections.abc import Sequence
from typing import Any

from driftjax.report.style import stage_label
from driftjax.store import RunFolder

CONTROLLERS = {"path": "path-tracking", "paper": "paper's", "pursuit": "pure pursuit", "lqr": "LQR"}
HEAD = ("stage", "controller", "lateral error [m]", "speed RMSE [m/s]", "drift share", "completed", "failures")
REDUCTIONS = {
    "reduction_gpr": "lateral error, GPR against nominal",
    "reduction_exploration": "lateral error, explored against GPR",
    "reduction_velocity_rmse": "speed RMSE, explored against GPR",
}
HUGE = 1e6  # from here on a number has two digits and an exponent: an interval over few plants may be that wide
TOO_FEW = "No intervals: there are fewer than three plants."


def number(value: float | None, form: str = ".2f") -> str:
    """Format a number; a dash where it is missing or not finite, two digits where it is huge."""
    if value is None or not math.isfinite(value):
        return "-"
    return format(value, form if abs(value) < HUGE else ".2g")


def cell(value: Any) -> str:
    """Format a value of any kind."""
    return number(value, ".4g") if value is None or isinstance(value, float) else str(value)


def with_interval(value: float | None, ci95: Any, form: str = ".2f", missing: str = "-") -> str:
    """Format a value with its 95 % interval where it has one; `missing` where there is no value."""
    low, high = ci95 or (None, None)
    if value is None or low is None or high is None:
        return missing if value is None else number(value, form)
    return f"{number(value, form)} [{number(low, form)}, {number(high, form)}]"


def format_interval(cell: dict[str, Any] | None, form: str = ".2f") -> str:
    """Format mean (or value) and 95 % interval of a summary, and the number of plants where some lack the figure."""
    cell = cell or {}
    few = f" ({cell['plants']}/{cell['all_plants']})" if 0 < cell.get("plants", 0) < cell["all_plants"] else ""
    return with_interval(cell.get("mean", cell.get("value")), cell.get("ci95"), form) + few


def result_row(stage: str, controller: str, cell: dict[str, Any]) -> tuple[str, ...]:
    """Format one stage and controller of results.json, in the columns of `HEAD`."""
    done, of = cell.get("completed") or (0, 0)
    codes = {code: count for code, count in (cell.get("codes") or {}).items() if code != "COMPLETED" and count}
    failed = [f"{count} {code.lower().replace('_', ' ')}" for code, count in codes.items()]
    converged, tried = cell.get("references_found") or (0, 0)
    failed += [f"{tried - converged} references not found"] if converged < tried else []
    failures = ", ".join(failed) or "none"
    share = (cell.get("drift_share") or {}).get("mean")
    errors = format_interval(cell.get("lateral_error")), format_interval(cell.get("velocity_rmse"))
    name = CONTROLLERS.get(controller, controller)
    return (stage_label(stage), name, *errors, number(share), f"{done}/{of}", failures)


def markdown_table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as the lines of a Markdown table; the first is the head."""
    return ["| " + " | ".join(row) + " |" for row in (rows[0], ["---"] * len(rows[0]), *rows[1:])]


def aligned(rows: list[tuple[str, ...]]) -> list[str]:
    """Return rows as lines with aligned columns; a rule follows the first."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return [lines[0], "-" * (sum(widths) + 2 * len(widths) - 2), *lines[1:]]


def results_table(results: dict[str, Any]) -> str:
    """Format the results of `driftjax learn`: a row per stage and controller, then the reductions."""
    rows: list[tuple[str, ...]] = [HEAD]
    for stage in results.get("stages") or []:
        rows += [result_row(stage["name"], controller, cell) for controller, cell in stage["controllers"].items()]
    summary = results.get("summary") or {}
    reductions = _reductions(summary) if summary else []
    cells = [cell for row in (*rows[1:], *reductions[1:]) for cell in row]
    lines = aligned(rows)
    lines += ["", "Lateral error: mean magnitude against the planned minimum-time path over the drift section."]
    if any("[" in cell for cell in cells):
        lines += ["In brackets: 95 % interval over plants by Student's t, of reductions on the log ratio of means."]
    elif len(rows) > 1:
        lines += [TOO_FEW]
    if any("/" in cell and cell.endswith(")") for cell in cells):
        lines += ["(n/N): of the n plants of N that reached the section."]
    return "\n".join([*lines, "", *aligned(reductions)] if reductions else lines)


def _reductions(summary: dict[str, Any]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [
        ("reduction [%]", *(CONTROLLERS.get(name, name) for name in summary), "Wu et al. 2025")
    ]
    for key, words in REDUCTIONS.items():
        cells = [(summary[controller] or {}).get(key) or {} for controller in summary]
        published = next((cell["paper"] for cell in cells if cell.get("paper") is not None), None)
        rows.append((words, *(format_interval(cell, ".1f") for cell in cells), number(published, ".1f")))
    return rows


def last_errors(results: dict[str, Any]) -> dict[str, float]:
    """Return each controller's mean lateral error [m] in its last stage, one that drives the best setting if any."""
    last: dict[str, float] = {}
    stages = results.get("stages") or []
    for stage in sorted(stages, key=lambda one: one["name"].endswith("-best")):  # stable: those come last
        for controller, cell in stage["controllers"].items():
            mean = (cell.get("lateral_error") or {}).get("mean")
            if mean is not None:
                last[controller] = mean
    return last


def run_line(run: RunFolder) -> str:
    """Format one line about a run: time, verb, car, state, errors of its last laps, folder."""
    stages = run.finished()
    car = str(run.config.get("car", run.config.get("vehicle", "")))
    if run.verb != "learn":
        results = ("plan.nc", "results.json", "diagnosis.json", "compare.json", "log.csv")
        state = "done" if any(map(run.has, results)) else "unfinished"
    else:
        state = f"{len(stages)} stages" if run.has("results.json") else f"stopped after {(stages or ['nothing'])[-1]}"
    last = last_errors(run.read_json("results")) if run.verb == "learn" and run.has("results.json") else {}
    last = {name: error for name, error in last.items() if name in ("path", "paper")} or last
    words = ", ".join(f"{controller} {error:.2f} m" for controller, error in last.items())
    return f"{run.created[:16].replace('T', ' ')}  {run.verb:10s}  {car:8s}  {state:21s}  {words or '-'}  {run.path}"
