"""Report the share of each named effect in the explained error, and the held-out error without it."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from driftjax.logs.columns import MEASURED
from driftjax.report.style import COMPARED, new_figure
from driftjax.report.table import aligned, with_interval


def error_share_table(content: dict[str, Any]) -> str:
    """Format family, probability and share of every cause, and the growth of the error without it; empty without any.

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
        name = cause["effect"] + (" (exploratory)" if cause.get("exploratory") else "")
        rows.append((name, f"{cause['probability']:.2f}", cause["family"], family, share, *grown))
    note = "without it: error on held-out runs over that with all, others refitted; -: not named without those runs"
    return "\n".join([*aligned(rows), note]) + "\n"


def waterfall(content: dict[str, Any]) -> list[tuple[str, float, float]]:
    """Return the steps of the waterfall of the excess error, one per named effect: name, before, after [%].

    Each takes its share of what all of them explain of the excess squared error at the decisive horizon.
    Empty where nothing is named or explained.
    """
    causes = sorted((c for c in content.get("causes", ()) if "share" in c), key=lambda one: -one["share"])
    explained = content.get("explained")
    if not causes or not explained or explained["share"] is None:
        return []
    explained_share = max(explained["share"], 0.0)
    level = 100 * np.cumsum([1.0, *(-explained_share * cause["share"] for cause in causes)])
    steps = zip((cause["effect"] for cause in causes), level[:-1].tolist(), level[1:].tolist(), strict=True)
    return [("nominal car", 0.0, 100.0), *steps, ("left", 0.0, float(level[-1]))]


def plot_error_shares(content: dict[str, Any]) -> Figure | None:
    """Plot the waterfall of the named effects; None without any."""
    steps = waterfall(content)
    if not steps:
        return None
    figure, axes = new_figure(1, 1, (max(1.3 * len(steps), 5.5), 4.2))
    axis, last = axes[0, 0], len(steps) - 1
    for k, (_, before, after) in enumerate(steps):
        colour = COMPARED["nominal"][0] if k == 0 else "0.6" if k == last else COMPARED["extended"][0]
        axis.bar(k, after - before, bottom=before, color=colour)
        if k:
            axis.text(k, max(before, after) + 1.5, f"{abs(after - before):.0f} %", ha="center", fontsize=9)
        if 0 < k < last:
            axis.plot([k - 1.4, k + 0.4], [before] * 2, color="0.5", lw=0.8)
    axis.set_xticks(range(len(steps)), [name for name, _, _ in steps], rotation=20, ha="right")
    axis.set_ylabel(f"excess squared error {content['explained']['horizon']:.2g} s ahead [%]")
    axis.set_ylim(min(0.0, *(after for _, _, after in steps)) - 2, 110)
    return figure
