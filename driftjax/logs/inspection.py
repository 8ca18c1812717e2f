"""Summary of a log: channels with ranges and gaps, rates, and consistency of the channels."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from driftjax.logs.agreement import Agreement, agreements
from driftjax.logs.columns import CHANNELS
from driftjax.logs.log import Log

UNITS = {"V": "m/s", "beta": "rad", "r": "rad/s", "delta": "rad", "Fxr": "N", "x": "m", "y": "m", "s": "m", "e": "m",
         "psi": "rad", "ax": "m/s^2", "ay": "m/s^2"}  # fmt: skip


@dataclass(frozen=True)
class Inspection:
    """Channels of a log and their consistency; `str` is the table that the command line prints."""

    log: Log
    channels: dict[str, dict[str, Any]]
    """Per channel: unit, percent_1, median, percent_99, share missing, number of runs."""
    agreement: list[Agreement]
    """How each channel follows what the others say of it, whatever the car."""

    def content(self) -> dict[str, Any]:
        """Return the contents of inspection.json."""
        runs = {run.name: {"seconds": len(run.t) * run.dt, "rate_Hz": 1 / run.dt} for run in self.log.runs}
        return {"sha256": self.log.sha256, "rows": self.log.rows, "notes": list(self.log.notes), "runs": runs,
                "channels": self.channels, "agreement": [one._asdict() for one in self.agreement]}  # fmt: skip

    def __str__(self) -> str:
        runs = self.log.runs
        seconds = sum(len(run.t) * run.dt for run in runs)
        lines = [f"{len(runs)} runs, {seconds:.1f} s at {1 / runs[0].dt:.4g} Hz", "",
                 f"{'channel':8} {'unit':6} {'1 %':>10} {'median':>10} {'99 %':>10} {'missing':>8}  runs"]  # fmt: skip
        number = lambda value: f"{'none' if value is None else f'{value:.4g}':>10}"
        for name, row in self.channels.items():
            values = " ".join(number(row[key]) for key in ("percent_1", "median", "percent_99"))
            lines.append(f"{name:8} {row['unit']:6} {values} {100 * row['missing']:7.1f}%  {row['runs']}")
        lines += ["", "channel against what others say of it: slope, offset, what is left (RMS), correlation, late by"]
        for one in self.agreement:
            interval = "" if np.isnan(one.shift_half_width) else f" ± {1000 * one.shift_half_width:.0f}"
            late = f"{1000 * one.shift:+6.0f}{interval} ms"
            lines.append(f"{one.channel:5} {one.other:42} {one.slope:7.3f} {one.offset:+9.3g} {one.rest:9.3g} "
                         f"{one.unit:6} {one.correlation:6.3f} {late}")  # fmt: skip
        return "\n".join(lines)


def inspect(log: Log, wheelbase: float | None = None) -> Inspection:
    """Summarise the channels of a log and check whether they agree with each other.

    Each channel that others determine is compared with that prediction: slope, offset, time shift [s]. With the car's
    `wheelbase` [m] the yaw rate is compared with the steering, too. `str` of the result is a table; `content()` gives
    plain values in SI.
    """
    return Inspection(log, _channels(log), agreements(log.runs, wheelbase))


def _channels(log: Log) -> dict[str, dict[str, Any]]:
    """Return unit, range and missing share of every channel over all runs that have it."""
    parts = {name: [getattr(run, name) for run in log.runs] for name in CHANNELS[1:]}
    for run in log.runs:
        for name, values in run.extra.items():
            parts.setdefault(name, []).append(values)
    rows = {}
    for name, columns in parts.items():
        values = np.concatenate(columns)
        there = values[np.isfinite(values)]
        low, middle, high = (float(q) for q in np.percentile(there, [1, 50, 99])) if len(there) else (None,) * 3
        rows[name] = {"unit": UNITS.get(name, "rad/s"), "percent_1": low, "median": middle, "percent_99": high,
                      "missing": 1 - len(there) / len(values), "runs": len(columns)}  # fmt: skip
    return rows
