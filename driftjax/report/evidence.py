"""Why an effect is named: scores of all effects, probabilities with rivals, and which effects look alike."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from driftjax.report.style import EXPLORED, new_figure

BARS = 24  # effects in the bar chart at most
CELLS = 16  # parameters in the heat map at most
PLAIN, RIVAL = "#8FA3B0", "#C9B27C"


def _best(data: xr.Dataset) -> list[tuple[str, float, bool]]:
    """Effects with the largest |score| of their parameters and whether they were named, largest first."""
    found: dict[str, tuple[float, bool]] = {}
    for name, score, named in zip(*(data[key].values for key in ("parameter", "score", "named")), strict=True):
        effect = str(name).split(".")[0]
        found[effect] = max(found.get(effect, (0.0, bool(named))), (abs(float(score)), bool(named)))
    rows = sorted(((name, *value) for name, value in found.items()), key=lambda row: -row[1])
    return rows


def scores(data: xr.Dataset) -> Figure:
    """Size of the score of every effect at the nominal car, with what chance passes once in twenty data sets."""
    every = _best(data)
    rows = every[:BARS] + [row for row in every[BARS:] if row[2]]
    figure, axes = new_figure(1, 1, (8.0, 0.24 * len(rows) + 1.5))
    axis, at = axes[0, 0], np.arange(len(rows))
    axis.barh(at, [row[1] for row in rows], color=[EXPLORED if row[2] else PLAIN for row in rows], zorder=2)
    threshold = data.attrs["score_threshold"]
    axis.axvline(threshold, color="black", ls="--", lw=1.2, zorder=3)
    axis.annotate("5 % by chance", (threshold, 1.0), xycoords=("data", "axes fraction"), xytext=(4, 2),
                  textcoords="offset points", fontsize=8.5, va="bottom")  # fmt: skip
    axis.set_yticks(at, [row[0] for row in rows], fontsize=9)
    for label, row in zip(axis.get_yticklabels(), rows, strict=True):
        label.set_fontweight("bold" if row[2] else "normal")
    axis.set_ylim(len(rows) - 0.4, -0.6)
    axis.grid(False, axis="y")
    axis.set_xlabel("|studentised score| at the nominal car [-]; named effects red")
    axis.set_title(f"{len(rows)} of {len(every)} effects" if len(rows) < len(every) else "", loc="left", pad=14)
    return figure


def posterior(diagnosis: dict[str, Any]) -> Figure | None:
    """Probability of each named effect and of its rivals, a row per place, with the parameters' intervals."""
    causes = diagnosis["causes"]
    if not causes:
        return None
    figure, axes = new_figure(1, 1, (9.0, 0.95 * len(causes) + 1.2))
    axis = axes[0, 0]
    for row, cause in enumerate(causes):
        shares = {cause["effect"]: cause["probability"], **cause.get("rivals", {})}
        left = 0.0
        for name, share in shares.items():
            mine = name == cause["effect"]
            axis.barh(row, share, 0.42, left=left, color=EXPLORED if mine else RIVAL, ec="white", zorder=2)
            if share > 0.03 + 0.011 * len(f"{name} {share:.2f}"):
                axis.text(left + share / 2, row, f"{name} {share:.2f}", ha="center", va="center", fontsize=9,
                          color="white" if mine else "black", zorder=3)  # fmt: skip
            left += share
        axis.barh(row, 1 - left, 0.42, left=left, color="0.9", zorder=2) if left < 0.995 else None
        words = ";  ".join(_interval(name, value) for name, value in cause["parameters"].items())
        if cause["confusable_with"]:
            words += f";  hard to tell from {', '.join(cause['confusable_with'][:3])}"
        axis.text(0, row - 0.3, words, fontsize=9, va="bottom")
    axis.set_yticks([])
    axis.set_ylim(len(causes) - 0.6, -0.75)
    axis.set_xlim(0, 1)
    axis.grid(False, axis="y")
    axis.set_xlabel("probability in its place [-]: named effects red, rivals tan, the rest grey")
    return figure


def _interval(name: str, value: dict[str, Any]) -> str:
    low, high = value["ci95"]
    unit = "" if value["unit"] == "1" else f" {value['unit']}"
    return f"{name} = {value['value']:.3g}{unit}, 95 % in [{low:.3g}, {high:.3g}]"


def confusability(data: xr.Dataset) -> Figure:
    """How alike the signatures of the parameters with the largest scores are, those of named effects first."""
    order = sorted(range(data.sizes["parameter"]), key=lambda i: (
        not bool(data["named"][i]), -abs(float(data["score"][i]))
    ))[:CELLS]  # fmt: skip
    part = data["cosine"].values[np.ix_(order, order)]
    names = [str(name) for name in data["parameter"].values[order]]
    size = 0.36 * len(order) + 2.6
    figure, axes = new_figure(1, 1, (size + 0.6, size))
    axis = axes[0, 0]
    image = axis.imshow(part, vmin=0, vmax=1, cmap="Blues")
    for i, j in np.ndindex(*part.shape):
        if np.isfinite(part[i, j]) and i != j and part[i, j] >= 0.5:
            axis.text(j, i, f"{part[i, j]:.2f}"[1:] if part[i, j] < 0.995 else "1", ha="center", va="center",
                      fontsize=7.5, color="white" if part[i, j] > 0.6 else "black")  # fmt: skip
    axis.set_xticks(range(len(names)), names, rotation=60, ha="right", rotation_mode="anchor", fontsize=8.5)
    axis.set_yticks(range(len(names)), names, fontsize=8.5)
    for labels in (axis.get_xticklabels(), axis.get_yticklabels()):
        for label, i in zip(labels, order, strict=True):
            label.set_color(EXPLORED if bool(data["named"][i]) else "black")
    axis.grid(False)
    figure.colorbar(image, ax=axis, shrink=0.8, label="|cosine| of two signatures [-]; 1: no telling apart")
    return figure
