"""Colours, sections and saving, shared by all figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

NOMINAL, GPR, EXPLORED, OTHER = "#4D4D4D", "#0072B2", "#C8102E", "#A08040"
NORMAL, DRIFT = "#0072B2", "#C8102E"  # segments of the plan, as in the paper
PINK, YELLOW, ORANGE = "#F6C6D0", "#FFF3B8", "#FAD7A8"
COMPARED = {
    "nominal": (NOMINAL, "nominal"),
    "retuned": (OTHER, "re-tuned tyres"),
    "extended": (EXPLORED, "extended"),
    "gp": (GPR, "Gaussian process"),
    "extended_gp": ("#2E8B57", "extended, with a Gaussian process"),
}  # models of a diagnosis
DRIVES = {
    "nominal": NOMINAL,
    "gpr": GPR,
    "explored": EXPLORED,
    "measured": GPR,
    "extended": EXPLORED,
    "other": OTHER,
}  # cars that move, by kind
ERROR_LABEL = "lateral error against the\nplanned minimum-time path [m]"
CONTROLLERS = {"path": "path-tracking controller", "paper": "paper's controller"}
STYLE: dict[Any, Any] = {
    "font.size": 10.0, "axes.titlesize": 10.5, "axes.labelsize": 10.0, "legend.fontsize": 9.0, "axes.grid": True,
    "grid.alpha": 0.25, "grid.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False,
    "lines.linewidth": 1.6, "legend.framealpha": 0.9, "pdf.fonttype": 42, "savefig.dpi": 140,
}  # fmt: skip


KINDS = {
    "nominal": (NOMINAL, "nominal MPC"),
    "gpr": (GPR, "GPR, best laps"),
    "explored": (EXPLORED, "explored, best laps"),
}


def stage_colour(name: str) -> str:
    """Return the colour of a stage: grey nominal, blue GPR, red explored, tan for the controllers compared with."""
    if name == "nominal":
        return NOMINAL
    if name.startswith("gpr"):
        return GPR
    return EXPLORED if name.startswith("explore") else OTHER


def stage_label(name: str) -> str:
    """Return the name of a stage in figures and tables."""
    kind, _, number = name.partition("-")
    if kind == "gpr":
        return f"GPR lap {number}"
    if kind == "explore":
        return f"explored {number}"
    return {
        "nominal": "nominal MPC",
        "paper": "nominal MPC",
        "pursuit": "pure pursuit",
        "lqr": "LQR",
        "single-layer": "single-layer GPR",
    }[name]


def new_figure(rows: int, columns: int, size: tuple[float, float], **more: Any) -> tuple[Figure, Any]:
    """Create a figure in the common style; axes are a 2-D array."""
    with plt.rc_context(STYLE):
        return plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False, **more)


def save(figure: Figure, folder: Path, name: str) -> Path:
    """Write `name`.png and `name`.pdf into `folder`, close the figure, return the PNG's path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.png"
    with plt.rc_context(STYLE):
        figure.savefig(path)
        figure.set_layout_engine("none")  # laid out by now; a second time takes as long again
        figure.savefig(path.with_suffix(".pdf"))
    plt.close(figure)
    return path


def panel_grid(num: int, most: int, width: float, height: float, **options: Any) -> tuple[Figure, list[Axes]]:
    """Create `num` panels in rows of at most `most`, each `width` by `height` inches; returns figure and panels."""
    columns = min(most, num)
    rows = -(-num // columns)
    figure, axes = new_figure(rows, columns, (width * columns, height * rows), **options)
    for axis in axes.flat[num:]:
        axis.set_visible(False)
    return figure, list(axes.flat[:num])


def legend_below(figure: Figure, axis: Axes, columns: int) -> None:
    """Draw the legend of `axis` below all panels."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=9, frameon=False)


def shade(axis: Axes, spans: Sequence[tuple[float, float]], colour: str, label: str | None = None) -> None:
    """Shade spans of the horizontal axis behind the curves."""
    for start, end in spans:
        axis.axvspan(start, end, color=colour, lw=0, zorder=0, label=label)
        label = None


def equal_axes(axis: Axes) -> None:
    """Set up axes of world coordinates: equal scales, metres."""
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
