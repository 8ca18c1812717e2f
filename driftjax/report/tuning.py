"""Write the results of `driftjax tune` as text and one figure."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from driftjax.report.style import EXPLORED, GPR, NOMINAL, new_figure, save
from driftjax.report.table import aligned, format_interval, number
from driftjax.store import RunFolder

KINDS = {"default": (NOMINAL, "default"), "tuned": (EXPLORED, "tuned by gradients"), "random": (GPR, "random search")}


def tuning_summary(results: dict[str, Any]) -> str:
    """Format settings, losses and differences as a table, and the winner in sentences."""
    held, settings = results["held_out"], results["settings"]
    num = len(held["plants"])
    columns = ("laps", "training loss", "held-out loss", "lateral error [m]", "completed")
    head = ("setting", *results["parameters"], *columns)
    rows = [head] + [
        (
            label,
            *(format(value, ".3g") for value in settings[kind]["values"].values()),
            str(settings[kind]["cost"]),
            number(settings[kind]["loss"], ".3f"),
            format_interval(held["loss"][kind], ".3f"),
            format_interval(held["lateral_error"][kind], ".3f"),
            f"{held['completed'][kind]}/{num}",
        )
        for kind, (_, label) in KINDS.items()
    ]
    lines = [
        *aligned(rows),
        "",
        "Paired differences on the plants held out (in brackets: 95 % interval over plants, Student's t):",
    ]
    lines += [
        f"  {pair}: loss {format_interval(cell, '.3f')}, lateral error {format_interval(apart, '.3f')} m"
        for (pair, cell), apart in zip(
            held["loss_difference"].items(), held["lateral_error_difference"].values(), strict=True
        )
    ]
    return "\n".join([*lines, "", *sentences(results)])


def sentences(results: dict[str, Any]) -> list[str]:
    """Return sentences on the winner of each comparison and on failed laps."""
    held, tuned, random = results["held_out"], results["settings"]["tuned"], results["settings"]["random"]
    return [
        f"Against the default, tuning by gradients {_verdict(held, 'tuned - default')}.",
        f"Against random search, tuning by gradients {_verdict(held, 'tuned - random')}.",
        f"Time: {tuned['seconds']:.0f} s by gradients ({tuned['slopes']} of them, {tuned['slope_seconds']:.0f} s), "
        f"{random['seconds']:.0f} s by random search, compiling included.",
        f"Laps that failed: {tuned['failed_laps']} and {random['failed_laps']}; "
        f"laps without derivatives, left out of a gradient: {tuned['laps_without_slope']}.",
    ]


def _verdict(held: dict[str, Any], pair: str) -> str:
    mean, (low, high) = held["loss_difference"][pair]["mean"], held["loss_difference"][pair]["ci95"]
    words = f"{'lowers' if mean < 0 else 'does not lower'} the mean loss on plants held out"
    if low is None:
        words += ", which are too few for an interval"
    elif low <= 0 <= high:
        words += ", but the interval of the difference holds 0"
    return f"{words}; it is lower on {held['loss_lower_on'][pair]} of {len(held['plants'])} of them"


def _ways(axis: Axes, results: dict[str, Any]) -> None:
    for kind in ("tuned", "random"):
        colour, label = KINDS[kind]
        cost, loss = np.array(results["settings"][kind]["history"]).T
        axis.step(cost, loss, where="post", color=colour, label=label)
    axis.set_xlabel("laps per training plant (a gradient counts as 7)")
    axis.set_ylabel("lowest training loss [-]")
    axis.set_ylim(bottom=0)
    axis.legend(loc="best")


def _pairs(axis: Axes, results: dict[str, Any]) -> None:
    plants = results["held_out"]["plants"]
    at = np.arange(len(KINDS))
    for plant in plants:
        axis.plot(at, [plant["loss"][kind] for kind in KINDS], color="0.75", lw=1.0, zorder=1)
    for i, (kind, (colour, _)) in enumerate(KINDS.items()):
        axis.plot(np.full(len(plants), i), [plant["loss"][kind] for plant in plants], "o", color=colour, ms=4)
        axis.plot([i - 0.2, i + 0.2], [results["held_out"]["loss"][kind]["mean"]] * 2, color=colour, lw=2.5)
    axis.set_xticks(at, [label for _, label in KINDS.values()])
    axis.set_ylabel("loss on plants held out [-]")
    axis.set_ylim(bottom=0)


def write_tuning(run: RunFolder) -> Path:
    """Write `tuning` as PNG and PDF, and `report.txt`; returns the path of the latter."""
    results = run.read_json("results")
    figure, axes = new_figure(1, 2, (10.0, 4.0))
    _ways(axes[0, 0], results)
    _pairs(axes[0, 1], results)
    save(figure, run.path / "figures", "tuning")
    path = run.path / "report.txt"
    path.write_text(tuning_summary(results) + "\n", encoding="utf-8")
    return path
