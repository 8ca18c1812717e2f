"""Plot the side force over slip of the axles whose tyres have a form of their own."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from driftjax.report.style import COMPARED, new_figure


def plot_tyre_curves(content: dict[str, Any]) -> Figure | None:
    """Plot nominal and fitted curve with their band, as in diagnosis.json; None where no such effect is named."""
    curves = [cause["curve"] for cause in content.get("causes", ()) if cause.get("curve")]
    if not curves:
        return None
    figure, axes = new_figure(1, len(curves), (4.6 * len(curves), 3.6), sharey=True)
    for axis, curve in zip(axes[0], curves, strict=True):
        slip = np.degrees(curve["slip"])
        axis.plot(slip, curve["nominal"], color=COMPARED["nominal"][0], label="nominal")
        axis.plot(slip, curve["fitted"], color=COMPARED["extended"][0], label="fitted")
        axis.fill_between(slip, *curve["band"], color=COMPARED["extended"][0], alpha=0.25, lw=0)
        axis.set_xlabel(f"slip angle of the {curve['axle']} axle [deg]")
    axes[0, 0].set_ylabel("side force over load [-]")
    axes[0, 0].legend(loc="lower right")
    return figure
