"""Plot the posture of the car in the corner: its outline at even intervals."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from driftjax.report.laps import Lap, best_laps
from driftjax.report.plan import draw_track
from driftjax.report.shape import outline
from driftjax.report.style import CONTROLLERS, KINDS, equal_axes, new_figure
from driftjax.store import RunFolder
from driftjax.vehicle import VehicleConfig

OUTLINES = 12  # about how many cars are drawn through the corner


def _draw(axis: Axes, lap: Lap, vehicle: VehicleConfig, window: tuple[float, float], colour: str) -> None:
    axis.plot(lap["x"], lap["y"], color=colour, lw=1.2, zorder=3)
    inside = (lap["s"] >= window[0]) & (lap["s"] <= window[1])
    index = np.flatnonzero(inside)
    if index.size:
        wanted = np.linspace(*window, OUTLINES)
        wanted = wanted[wanted <= lap["s"][index[-1]] + 1e-9]
        for k in dict.fromkeys(index[np.abs(lap["s"][index][None, :] - wanted[:, None]).argmin(axis=1)].tolist()):
            corners = outline(lap["x"][k], lap["y"][k], lap["psi"][k], vehicle)
            axis.add_patch(Polygon(corners, closed=True, fc=colour, ec=colour, alpha=0.35, lw=1.0, zorder=4))
    if not lap.completed:
        axis.plot(lap["x"][-1], lap["y"][-1], "x", color="black", ms=9, mew=2.5, zorder=6)


def plot_posture(run: RunFolder, plan: xr.Dataset, controller: str, vehicle: VehicleConfig) -> Figure | None:
    """Plot the outlines of one plant's car through the corner, a panel each for nominal, GPR and explored."""
    kinds = best_laps(run, controller)
    if not kinds:
        return None
    plant = next(iter(kinds.values()))[0].plant
    start, end = plan.attrs["drift_start"], plan.attrs["drift_end"]
    window = (start - 2 * vehicle.length, end + 2 * vehicle.length)
    near = (plan["path_s"].values >= window[0]) & (plan["path_s"].values <= window[1])
    px, py = plan["path_x"].values[near], plan["path_y"].values[near]
    pad = 1.5 * vehicle.length
    wide, high = np.ptp(px) + 2 * pad, np.ptp(py) + 2 * pad
    panel = 3.6
    size = (panel * len(kinds) + 0.6, float(np.clip(panel * high / wide, 2.5, 7.0)) + 1.0)
    figure, axes = new_figure(1, len(kinds), size)
    for axis, (kind, laps) in zip(axes[0], kinds.items(), strict=True):
        (colour, name), lap = KINDS[kind], laps[0]
        draw_track(axis, plan)
        axis.plot(plan["path_x"], plan["path_y"], color="0.2", lw=1.0, ls="--", zorder=2)
        _draw(axis, lap, vehicle, window, colour)
        equal_axes(axis)
        ended = "" if lap.completed else f", {lap.code.lower().replace('_', ' ')} (x)"
        axis.set_title(name.removesuffix("s") + ended)
        axis.set_aspect("equal", adjustable="box")
        axis.set(xlim=(px.min() - pad, px.max() + pad), ylim=(py.min() - pad, py.max() + pad))
    for axis in axes[0, 1:]:
        axis.set_ylabel("")
        axis.tick_params(labelleft=False)
    label = CONTROLLERS.get(controller, controller)
    figure.suptitle(f"{label}, plant {plant}; dashed: planned minimum-time path", fontsize=10.5)
    return figure
