"""Files of a minimum-time plan: dataset, table, and figures of its drifts on the track and of its states."""

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from driftjax.planner import Plan
from driftjax.planner.dataset import plan_dataset, write_plan_csv
from driftjax.report.style import DRIFT, NORMAL, ORANGE, equal_axes, new_figure, save, shade
from driftjax.store.files import write_netcdf
from driftjax.track import Track
from driftjax.vehicle import VehicleConfig


def flagged_spans(flags: np.ndarray, s: np.ndarray) -> list[tuple[float, float]]:
    """Return the intervals of `s` in which `flags` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [(float(s[a]), float(s[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def draw_track(axis: Axes, plan: xr.Dataset) -> None:
    """Draw borders and centre line."""
    for side, style in (("left", "-"), ("right", "-"), ("track", ":")):
        x, y = plan[f"{side}_x"].values, plan[f"{side}_y"].values
        if plan.attrs.get("closed"):
            x, y = np.append(x, x[0]), np.append(y, y[0])
        axis.plot(x, y, style, color="0.35", lw=0.8 if style == ":" else 1.2, zorder=1)


def plot_trajectory(plan: xr.Dataset) -> Figure:
    """Plot the planned path on the track, normal segments blue, drift segments red."""
    x, y = plan["x"].values, plan["y"].values
    wide, high = np.ptp(plan["right_x"].values), np.ptp(plan["right_y"].values)
    width = 8.0
    figure, axes = new_figure(1, 1, (width, float(np.clip(width * high / wide + 1.1, 3.2, 8.0))))
    axis = axes[0, 0]
    draw_track(axis, plan)
    axis.plot(x, y, color=NORMAL, lw=2.2, label="normal driving", zorder=2)
    label: str | None = "drift"
    for a, b in flagged_spans(plan["drift"].values.astype(bool), np.arange(len(x))):
        axis.plot(x[int(a) : int(b) + 1], y[int(a) : int(b) + 1], color=DRIFT, lw=2.6, label=label, zorder=3)
        label = None
    axis.plot(x[0], y[0], "o", color=NORMAL, ms=6, zorder=4)
    axis.annotate("start", (x[0], y[0]), textcoords="offset points", xytext=(6, 8), fontsize=9)
    equal_axes(axis)
    axis.legend(loc="best")
    axis.set_title(f"{plan.attrs['car']}: planned minimum-time trajectory, {plan.attrs['lap_time']:.2f} s")
    return figure


def plot_states(plan: xr.Dataset) -> Figure:
    """Plot speed, sideslip and yaw rate over the planned path, drift sections shaded."""
    s = plan["S"].values if "S" in plan else plan["s"].values
    figure, axes = new_figure(3, 1, (7.5, 6.2), sharex=True)
    rows = (("V", "speed V [m/s]", 1.0), ("beta", "sideslip beta [deg]", 180 / np.pi),
            ("r", "yaw rate r [deg/s]", 180 / np.pi))  # fmt: skip
    drift = flagged_spans(plan["drift"].values.astype(bool), s)
    for axis, (name, label, factor) in zip(axes[:, 0], rows, strict=True):
        shade(axis, drift, ORANGE, "drift section" if name == "V" else None)
        axis.plot(s, plan[name].values * factor, color=NORMAL)
        axis.axhline(0, color="0.4", lw=0.7) if name != "V" else None
        axis.set_ylabel(label)
        axis.margins(x=0)
    if plan["drift"].values.any():
        axes[0, 0].legend(loc="best")
    axes[0, 0].set_title(f"{plan.attrs['car']}: planned states; sideslip and yaw rate of opposite sign are a drift")
    axes[-1, 0].set_xlabel("arc length s along the planned path [m]")
    figure.align_ylabels()
    return figure


def write_plan_figures(plan: xr.Dataset, folder: Path) -> list[Path]:
    """Write `plan_trajectory` and `plan_states` as PNG and PDF; returns the paths of the PNGs."""
    return [save(plot_trajectory(plan), folder, "plan_trajectory"), save(plot_states(plan), folder, "plan_states")]


def save_plan(plan: Plan, track: Track, vehicle: VehicleConfig, folder: str | Path) -> Path:
    """Write plan.nc, plan.csv and figures of the `plan` of `vehicle` along `track` into `folder`; returns the folder.

    Both files hold the plan's nodes in SI units and radians, left positive; plan.nc also holds track and path.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    data = plan_dataset(plan, track, vehicle.name)
    write_netcdf(folder / "plan.nc", data)
    write_plan_csv(folder / "plan.csv", data)
    write_plan_figures(data, folder)
    return folder
