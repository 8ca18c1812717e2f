"""`driftjax inspect`: what is in a log, and whether its channels agree."""

import dataclasses
from pathlib import Path

import numpy as np
import tyro

from driftjax.cli.console import default_out, typed, within
from driftjax.logs import CHANNELS, Log, read_log
from driftjax.logs.agreement import Agreement, agreements
from driftjax.report import write_inspection
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle

UNITS = {"V": "m/s", "beta": "rad", "r": "rad/s", "delta": "rad", "Fxr": "N", "x": "m", "y": "m", "s": "m", "e": "m",
         "psi": "rad", "ax": "m/s^2", "ay": "m/s^2"}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Inspect:
    """What is in a log: channels with ranges and gaps, rates, and whether the channels agree with each other."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Logs, as for `driftjax diagnose`."""
    columns: str | None = None
    """Column map of foreign logs: a shipped name or a YAML; left out: the log format."""
    vehicle: Path | None = None
    """Vehicle whose wheelbase the yaw rate is compared by: a shipped name or a vehicle YAML; left out: it is not."""
    out: Path | None = None
    """Output folder; runs/inspect-LOG-TIME where left out."""


def run(argv: list[str]) -> int:
    """Read, compare, tell."""
    asked = typed(Inspect, argv, "driftjax inspect")
    vehicle = load_vehicle(asked.vehicle) if asked.vehicle else None
    log = read_log(asked.logs, asked.columns)
    options = {"logs": [str(path) for path in asked.logs], "columns": asked.columns,
               "vehicle": str(asked.vehicle) if asked.vehicle else None}  # fmt: skip
    folder = RunFolder.create(asked.out or default_out("inspect", asked.logs[0].stem), options, "inspect")

    def work() -> int:
        found = agreements(log.runs, vehicle.a + vehicle.b if vehicle else None)
        content = inspection(log, found)
        folder.write_json("inspection", content)
        for note in log.notes:
            print(f"note: {note}")
        print(told(log, content, found))
        for path in write_inspection(log.runs, folder.path):
            print(f"figure: {path}")
        return 0

    return within(folder, work)


def inspection(log: Log, found: list[Agreement]) -> dict:
    """Everything told, as JSON."""
    runs = {run.name: {"seconds": len(run.t) * run.dt, "rate_Hz": 1 / run.dt} for run in log.runs}
    return {"sha256": log.sha256, "rows": log.rows, "notes": list(log.notes), "runs": runs,
            "channels": channels(log), "agreement": [one._asdict() for one in found]}  # fmt: skip


def channels(log: Log) -> dict[str, dict]:
    """Unit, range, and share missing of every channel, over all runs that have it."""
    each = {name: [getattr(run, name) for run in log.runs] for name in CHANNELS[1:]}
    for run in log.runs:
        for name, values in run.extra.items():
            each.setdefault(name, []).append(values)
    rows = {}
    for name, parts in each.items():
        values = np.concatenate(parts)
        there = values[np.isfinite(values)]
        low, middle, high = (float(q) for q in np.percentile(there, [1, 50, 99])) if len(there) else (None,) * 3
        rows[name] = {"unit": UNITS.get(name, "rad/s"), "percent_1": low, "median": middle, "percent_99": high,
                      "missing": 1 - len(there) / len(values), "runs": len(parts)}  # fmt: skip
    return rows


def told(log: Log, content: dict, found: list[Agreement]) -> str:
    """The tables on the screen."""
    seconds = sum(one["seconds"] for one in content["runs"].values())
    lines = [f"{len(log.runs)} runs, {seconds:.1f} s at {1 / log.runs[0].dt:.4g} Hz", "",
             f"{'channel':8} {'unit':6} {'1 %':>10} {'median':>10} {'99 %':>10} {'missing':>8}  runs"]  # fmt: skip
    number = lambda value: f"{'none' if value is None else f'{value:.4g}':>10}"
    for name, row in content["channels"].items():
        values = " ".join(number(row[key]) for key in ("percent_1", "median", "percent_99"))
        lines.append(f"{name:8} {row['unit']:6} {values} {100 * row['missing']:7.1f}%  {row['runs']}")
    lines += ["", "channel against what others say of it: slope, offset, what is left (RMS), correlation, late by"]
    for one in found:
        lines.append(f"{one.channel:5} {one.other:42} {one.slope:7.3f} {one.offset:+9.3g} {one.rest:9.3g} {one.unit:6} "
                     f"{one.correlation:6.3f} {1000 * one.shift:+6.0f} ms")  # fmt: skip
    return "\n".join(lines)
