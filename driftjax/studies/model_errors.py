"""Figure of the prediction errors of several diagnoses, model by model."""

from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from driftjax.report.style import COMPARED

CHANNELS = {"V": "speed", "beta": "sideslip", "r": "yaw rate"}


def plot_model_errors(gains: dict[str, dict[str, Any]]) -> Figure:
    """Plot errors on held-out runs, 2 sqrt(L/g) ahead, over those of the nominal car: a group of bars per log.

    `gains` maps the name of a log to the block `gain` of its diagnosis.json; logs without a held-out run have no bars.
    """
    figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained", sharey=True)
    for axis, (channel, words) in zip(axes, CHANNELS.items(), strict=True):
        for place, gain in enumerate(gains.values()):
            if gain["skill_horizon_s"] is None:
                continue
            at = gain["horizons_s"].index(gain["skill_horizon_s"])
            models = [name for name in COMPARED if name in gain["rmse"]]
            for k, name in enumerate(models):
                ratio = gain["rmse"][name][channel][at] / gain["rmse"]["nominal"][channel][at]
                axis.bar(place + 0.16 * (k - (len(models) - 1) / 2), ratio, 0.15, color=COMPARED[name][0],
                         label=COMPARED[name][1] if place == 0 else None)  # fmt: skip
        axis.set_xticks(np.arange(len(gains)), [name.replace("_", "\n") for name in gains], fontsize=8)
        axis.set_yscale("log")
        axis.set_yticks([0.1, 0.2, 0.5, 1, 2, 5], ["0.1", "0.2", "0.5", "1", "2", "5"])
        axis.set_yticks([], minor=True)
        axis.set_title(words)
        axis.axhline(1, color="0.6", lw=0.8)
    axes[0].set_ylabel("error after 2 sqrt(L/g) on held-out runs,\nover that of the nominal car [-]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
    return figure
