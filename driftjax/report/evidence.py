"""Plot the evidence for named effects: scores, probabilities with rivals, and confusable effects."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from driftjax.report.style import EXPLORED, new_figure

BARS = 24  # effects in the bar chart at most
CELLS = 16  # parameters in the heat map at most
PLAIN, RIVAL = "#8FA3B0", "#C9B27C"


def best_scores(data: xr.Dataset) -> list[tuple[str, float, float, bool]]:
    """Return each effect with its predicted fall of the cost, largest |score| and whether it is named, best first."""
    owner = np.array([str(name).split(".")[0] for name in data["parameter"].values])
    score, named = np.abs(data["score"].values), data["named"].values
    each = ((str(name), owner == name) for name in data["effect"].values)
    rows = [
        (name, float(data["promise"].sel(effect=name)), float(score[mine].max()), bool(named[mine].any()))
        for name, mine in each
    ]
    return sorted(rows, key=lambda row: -row[1])


def plot_scores(data: xr.Dataset) -> Figure:
    """Plot the predicted fall of the cost and the score of every effect, with the 5 % threshold of chance."""
    every = best_scores(data)
    rows = every[:BARS] + [row for row in every[BARS:] if row[3]]
    figure, axes = new_figure(1, 2, (9.5, 0.24 * len(rows) + 1.6), sharey=True)
    at, colours = np.arange(len(rows)), [EXPLORED if row[3] else PLAIN for row in rows]
    labels = ("predicted fall of the cost [-]", "|studentised score| [-]")
    for axis, column, label in zip(axes[0], (1, 2), labels, strict=True):
        axis.barh(at, [row[column] for row in rows], color=colours, zorder=2)
        axis.grid(False, axis="y")
        axis.set_xlabel(label)
    threshold = data.attrs["score_threshold"]
    axes[0, 1].axvline(threshold, color="black", ls="--", lw=1.2, zorder=3)
    axes[0, 1].annotate("5 % by chance", (threshold, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 3),
                        textcoords="offset points", fontsize=8.5, ha="center", va="bottom")  # fmt: skip
    axes[0, 0].set_yticks(at, [row[0] for row in rows], fontsize=9)
    for label, row in zip(axes[0, 0].get_yticklabels(), rows, strict=True):
        label.set_fontweight("bold" if row[3] else "normal")
    axes[0, 0].set_ylim(len(rows) - 0.4, -0.6)
    part = f"{len(rows)} of {len(every)} effects" if len(rows) < len(every) else "all effects"
    figure.suptitle(f"Errors of the nominal car, {part}; those named are red", fontsize=10.5)
    return figure


def plot_posterior(diagnosis: dict[str, Any]) -> Figure | None:
    """Plot the probability of each named effect and of its rivals, with the intervals of its parameters."""
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
        axis.text(0.004, row - 0.27, words, fontsize=9, va="bottom")
    axis.set_yticks([])
    axis.set_ylim(len(causes) - 0.65, -0.65)
    axis.set_xlim(0, 1)
    axis.grid(False)
    axis.spines["left"].set_visible(False)
    axis.set_xlabel("probability in its place [-]: named effects red, rivals tan, the rest grey")
    return figure


def _interval(name: str, value: dict[str, Any]) -> str:
    low, high = value["ci95"]
    unit = "" if value["unit"] == "1" else f" {value['unit']}"
    return f"{name} = {value['value']:.3g}{unit}, 95 % in [{low:.3g}, {high:.3g}]"


def plot_confusability(data: xr.Dataset) -> Figure:
    """Plot the cosines between the signatures of the parameters with the largest scores, named effects first."""
    order = sorted(range(data.sizes["parameter"]), key=lambda i: (
        not bool(data["named"][i]), -abs(float(data["score"][i]))
    ))[:CELLS]  # fmt: skip
    part = data["cosine"].values[np.ix_(order, order)]
    names = [str(name) for name in data["parameter"].values[order]]
    size = 0.36 * len(order) + 2.6
    figure, axes = new_figure(1, 1, (size + 0.9, size - 0.5))
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
