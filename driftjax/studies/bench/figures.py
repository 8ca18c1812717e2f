"""Plot how the costs grow: one log-log figure per size."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from driftjax.report.style import EXPLORED, GPR, NOMINAL, OTHER, new_figure, save

OURS, THEIRS = (EXPLORED, GPR), (NOMINAL, OTHER, "#2E8B57", "#7B5EA7", "#999999", "#C9A227")
MARKERS = "osv^D<>"


def write_curves(curves: Sequence[Mapping[str, Any]], out: Path) -> list[Path]:
    """Write a PNG and a PDF for each figure that the curves name; returns the paths of the PNGs."""
    names = dict.fromkeys(curve["figure"] for curve in curves)
    return [_draw([curve for curve in curves if curve["figure"] == name], out, name) for name in names]


def _draw(curves: Sequence[Mapping[str, Any]], out: Path, name: str) -> Path:
    figure, axes = new_figure(1, 1, (5.2, 4.4))
    axis = axes[0, 0]
    ours, theirs = cycle(OURS), cycle(THEIRS)
    for marker, curve in zip(cycle(MARKERS), curves, strict=False):
        own = curve["label"].startswith("driftjax")
        axis.loglog(curve["sizes"], curve["seconds"], "-" if own else "--", color=next(ours if own else theirs),
                    marker=marker, ms=4, label=curve["label"])  # fmt: skip
    smallest = min((size for curve in curves for size in curve["sizes"] if size > 0), default=1)
    if any(0 in curve["sizes"] for curve in curves):
        axis.set_xscale("symlog", linthresh=smallest)
    axis.set_xlabel(curves[0]["size"])
    axis.set_ylabel(f"time per {curves[0]['unit']} [s]")
    figure.legend(loc="outside upper center", ncols=2 if len(curves) > 3 else 1, fontsize=7.5)
    return save(figure, out / "figures", name)
