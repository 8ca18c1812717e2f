"""Report the worth of each named effect: its share of the explained error, and the held-out error without it."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from driftjax.logs.columns import MEASURED
from driftjax.report.style import COMPARED, new_figure
from driftjax.report.table import aligned, with_interval


def worth_table(content: dict[str, Any]) -> str:
    """Format family, probability and share of every cause, and what the error grows by without it; empty without any.

    `content` is that of diagnosis.json, also an older one.
    """
    causes = [cause for cause in content.get("causes", ()) if "share" in cause]
    if not causes:
        return ""
    without = content["gain"].get("without", {})
    rows: list[tuple[str, ...]] = [("effect", "P", "family", "P", "share of what is explained",
                                    *(f"{channel} without it" for channel in MEASURED))]  # fmt: skip
    for cause in sorted(causes, key=lambda one: -one["share"]):
        low, high = cause["share_ci95"]
        share = f"{100 * cause['share']:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"
        each = without.get(cause["effect"], {})
        grown = (with_interval(each[channel][0], each[channel][1:]) if channel in each else "-" for channel in MEASURED)
        family = f"{cause['family_probability']:.2f}"
        rows.append((cause["effect"], f"{cause['probability']:.2f}", cause["family"], family, share, *grown))
    note = "without it: error on held-out runs over that with all, others refitted; -: not named without those runs"
    return "\n".join([*aligned(rows), note]) + "\n"


def plot_worth(content: dict[str, Any]) -> Figure | None:
    """Plot how the named effects take the excess error of the nominal car down to what is left; None without any.

    Each takes its share of what all of them explain of the excess squared error at the decisive horizon.
    """
    causes = sorted((c for c in content.get("causes", ()) if "share" in c), key=lambda one: -one["share"])
    explained = content.get("explained")
    if not causes or not explained or explained["share"] is None:
        return None
    whole = max(explained["share"], 0.0)
    steps = 100 * np.array([1.0, *(-whole * cause["share"] for cause in causes)])
    level = np.cumsum(steps)
    names = ["nominal car", *(cause["effect"] for cause in causes), "left"]
    figure, axes = new_figure(1, 1, (max(1.3 * len(names), 5.5), 4.2))
    axis = axes[0, 0]
    axis.bar(0, level[0], color=COMPARED["nominal"][0])
    for k in range(1, len(steps)):
        axis.bar(k, steps[k], bottom=level[k - 1], color=COMPARED["extended"][0])
        axis.text(k, max(level[k - 1], level[k]) + 1.5, f"{-steps[k]:.0f} %", ha="center", fontsize=9)
        axis.plot([k - 1.4, k + 0.4], [level[k - 1]] * 2, color="0.5", lw=0.8)
    axis.bar(len(steps), level[-1], color="0.6")
    axis.text(len(steps), max(level[-1], 0) + 1.5, f"{level[-1]:.0f} %", ha="center", fontsize=9)
    axis.set_xticks(range(len(names)), names, rotation=20, ha="right")
    axis.set_ylabel(f"excess squared error {explained['horizon']:.2g} s ahead [%]")
    axis.set_ylim(min(0.0, float(level.min())) - 2, 110)
    return figure
