"""Plot what the exploration predicted: expected error and uncertainty of every candidate, lap by lap."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from driftjax.report.style import CONTROLLERS, EXPLORED, new_figure, stage_label
from driftjax.store import RunFolder


def plot_candidates(run: RunFolder, controller: str) -> Figure | None:
    """Plot expected error, uncertainty and knowledge gradient over speed and sideslip for the first plant.

    A column per exploration lap, each before it is driven; the chosen candidate is marked.
    """
    laps = [name for name in run.finished() if name.startswith("explore-") and "grid_V" in run.read_stage(name)]
    data = [run.read_stage(name) for name in laps]
    lanes = np.flatnonzero(data[0]["controller"].values == controller) if data else np.zeros(0, int)
    if not lanes.size:
        return None
    rows = {
        "grid_error": "expected error [m]",
        "grid_deviation": "standard deviation [m]",
        "grid_gain": "knowledge gradient [m]",
    }
    figure, axes = new_figure(len(rows), len(laps), (3.4 * len(laps) + 1.2, 7.6), sharex=True, sharey=True)
    for row, (name, words) in zip(axes, rows.items(), strict=True):
        values = [one[name].values[lanes[0]] for one in data]
        low, high = min(map(np.min, values)), max(map(np.max, values))
        drawn = [_map(axis, one.isel(lane=int(lanes[0])), name, (low, high))
                 for axis, one in zip(row, data, strict=True)]  # fmt: skip
        figure.colorbar(drawn[-1], ax=row, label=words)
        row[0].set_ylabel("sideslip [deg]")
    for axis, stage in zip(axes[0], laps, strict=True):
        axis.set_title(f"before {stage_label(stage)}")
    for axis in axes[-1]:
        axis.set_xlabel("cornering speed [m/s]")
    plant, label = data[0]["plant"].values[lanes[0]], CONTROLLERS.get(controller, controller)
    figure.suptitle(
        f"{label}: predicted for the candidates of plant {plant}; crossed: excited, ringed: driven", fontsize=10.5
    )
    return figure


def _map(axis: Axes, lap: xr.Dataset, name: str, limits: tuple[float, float]):
    """Draw one value of all candidates, the excited ones slightly above the others."""
    V, beta, excited = (lap[key].values for key in ("grid_V", "grid_beta", "grid_excited"))
    shift = 0.12 * np.ptp(np.unique(beta)) / max(len(np.unique(beta)) - 1, 1)
    y = np.rad2deg(np.abs(beta) + np.where(excited, shift, -shift))
    points = axis.scatter(V, y, c=lap[name].values, vmin=limits[0], vmax=limits[1], s=42, cmap="viridis", zorder=2)
    axis.plot(V[excited > 0], y[excited > 0], "x", color="white", ms=4, zorder=3)
    chosen = int(lap["grid_chosen"].values)
    axis.plot(V[chosen], y[chosen], "o", mfc="none", mec=EXPLORED, mew=2.0, ms=12, zorder=4)
    axis.grid(False)
    return points
