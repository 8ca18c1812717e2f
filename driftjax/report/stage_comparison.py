"""Plot the lateral error of all stages side by side, with intervals and every plant."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from driftjax.report.style import CONTROLLERS, ERROR_LABEL, new_figure, stage_colour, stage_label

WIDTH = 0.38  # of one bar, in stages


def _value(cell: dict[str, Any] | None, key: str) -> float:
    number = (cell or {}).get(key)
    return float("nan") if number is None else float(number)


def _bar(axis: Axes, at: float, width: float, row: dict[str, Any], colour: str, hatched: bool) -> None:
    """Plot one bar with its interval, the plants and the number of completed laps."""
    cell = row.get("lateral_error") or {}
    mean = _value(cell, "mean")
    if np.isfinite(mean):
        axis.bar(at, mean, width, color=colour, alpha=0.45 if hatched else 0.8, hatch="///" if hatched else None,
                 edgecolor=colour, lw=1.0, zorder=2)  # fmt: skip
        low, high = (float("nan") if v is None else float(v) for v in cell.get("ci95") or (None, None))
        if np.isfinite(low) and np.isfinite(high):
            axis.plot([at, at], [low, high], color="black", lw=1.6, zorder=4, solid_capstyle="butt")
    plants = [float(v) for v in (cell.get("per_plant") or {}).values() if v is not None]
    spread = np.linspace(-0.22, 0.22, len(plants)) * width if len(plants) > 1 else np.zeros(len(plants))
    axis.plot(at + spread, plants, "o", ms=4, mfc="white", mec="black", mew=0.8, zorder=5)
    done, of = row.get("completed") or (0, 0)
    words, tint = f"{done}/{of}", "black" if done == of else "#B00020"
    axis.annotate(words, (at, 0), xycoords=("data", "axes fraction"), xytext=(0, -12), textcoords="offset points",
                  ha="center", va="center", fontsize=8.5, color=tint,
                  fontweight="normal" if done == of else "bold")  # fmt: skip


def plot_comparison(results: dict[str, Any]) -> Figure | None:
    """Plot the mean lateral error of every stage and controller, with 95 % intervals and a point per plant."""
    stages = results.get("stages") or []
    if not stages:
        return None
    figure, axes = new_figure(1, 1, (max(7.5, 1.15 * len(stages) + 1.2), 4.6))
    axis = axes[0, 0]
    for place, stage in enumerate(stages):
        rows = stage["controllers"]
        width = WIDTH if len(rows) > 1 else 1.2 * WIDTH
        for k, (controller, row) in enumerate(rows.items()):
            at = place + (k - (len(rows) - 1) / 2) * (width + 0.04)
            _bar(axis, at, width, row, stage_colour(stage["name"]), controller == "paper")
    axis.set_xticks(range(len(stages)), [stage_label(stage["name"]).replace(" ", "\n", 1) for stage in stages])
    axis.tick_params(axis="x", pad=16, length=0)
    axis.grid(False, axis="x")
    axis.set_ylabel(f"mean {ERROR_LABEL}")
    axis.set_ylim(bottom=0)
    named = {controller for stage in stages for controller in stage["controllers"]}
    if {"path", "paper"} <= named:
        patches = [Patch(fc="0.5", alpha=0.8, ec="0.3", label=CONTROLLERS["path"]),
                   Patch(fc="0.5", alpha=0.45, ec="0.3", hatch="///", label=CONTROLLERS["paper"])]  # fmt: skip
        axis.legend(handles=patches, loc="upper right")
    axis.set_title(
        f"{results.get('car', '')}: mean (bar), 95 % interval (line), plants (points), laps completed (below)"
    )
    return figure
