"""Plot lateral error and speed over arc length: nominal, GPR, explored."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from driftjax.report.laps import Lap, best_laps, controlled_span, mean_curve, mean_figure
from driftjax.report.style import CONTROLLERS, ERROR_LABEL, KINDS, PINK, YELLOW, new_figure, shade
from driftjax.report.table import number
from driftjax.store import RunFolder


def _error(lap: Lap, s: np.ndarray) -> np.ndarray:
    return np.abs(lap.over(s, "e"))


def _sections(axis: Axes, plan: xr.Dataset, laps: list[Lap], s: np.ndarray) -> None:
    """Shade where pure pursuit (yellow) and the drift controller (pink) drive; dashed lines bound the planned drift."""
    span = controlled_span(laps)
    if span:
        shade(axis, [(s[0], span[0]), (span[1], s[-1])], YELLOW, "pure pursuit drives")
        shade(axis, [span], PINK, "drift controller drives")
    for edge in (plan.attrs["drift_start"], plan.attrs["drift_end"]):
        axis.axvline(edge, color="0.35", lw=0.9, ls="--")


def _stop_marks(axis: Axes, laps: list[Lap], value, colour: str) -> int:
    """Mark where laps failed with a cross; returns their number."""
    failed = [lap for lap in laps if not lap.completed and lap["s"].size]
    for lap in failed:
        s, y = lap["s"][-1], value(lap)
        axis.plot(s, y, "x", color=colour, ms=8, mew=2.2, zorder=5, clip_on=False)
    return len(failed)


def plot_lateral_error(run: RunFolder, plan: xr.Dataset, controller: str) -> Figure | None:
    """Plot the magnitude of the lateral error over arc length, thin lines per plant and bold means."""
    kinds = best_laps(run, controller)
    if not kinds:
        return None
    s = np.linspace(0, float(plan["path_s"][-1]), 500)
    figure, axes = new_figure(1, 1, (8.0, 4.8))
    axis = axes[0, 0]
    _sections(axis, plan, [lap for laps in kinds.values() for lap in laps], s)
    for kind, laps in kinds.items():
        (colour, name), mean = KINDS[kind], mean_curve(laps, s, _error)
        for lap in laps:
            axis.plot(s, _error(lap, s), color=colour, lw=0.7, alpha=0.45, ls="-" if lap.completed else ":")
        failed = _stop_marks(axis, laps, lambda lap: abs(lap["e"][-1]), colour)
        words = f"{name}: {mean_figure(laps, 'lateral_error'):.2f} m in the drift"
        words += f", {failed} of {len(laps)} failed (x)" if failed else ""
        axis.plot(s, mean, color=colour, lw=2.4, label=words)
    axis.set(xlabel="arc length s along the planned path [m]", ylabel=ERROR_LABEL, xlim=(0, s[-1]))
    axis.set_ylim(bottom=0)
    axis.plot([], [], color="0.3", lw=0.7, label="each plant (bold: mean of completed laps)")
    axis.plot([], [], color="0.35", lw=0.9, ls="--", label="planned drift, averaged over")
    axis.set_title(CONTROLLERS.get(controller, controller))
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def plot_velocity(run: RunFolder, plan: xr.Dataset, controller: str) -> Figure | None:
    """Plot speed and its reference in the drift section, GPR against explored, and their difference below."""
    kinds = {kind: laps for kind, laps in best_laps(run, controller).items() if kind != "nominal"}
    if not kinds:
        return None
    start, end = plan.attrs["drift_start"], plan.attrs["drift_end"]
    s = np.linspace(start, end, 300)
    figure, axes = new_figure(2, 1, (8.0, 5.8), sharex=True)
    deviation = lambda lap, s: lap.over(s, "V") - lap.over(s, "V_ref")
    for kind, laps in kinds.items():
        colour, name = KINDS[kind]
        for lap in laps:
            axes[0, 0].plot(s, lap.over(s, "V"), color=colour, lw=0.7, alpha=0.45)
            axes[1, 0].plot(s, deviation(lap, s), color=colour, lw=0.7, alpha=0.45)
        V, V_ref = (mean_curve(laps, s, lambda lap, s, k=key: lap.over(s, k)) for key in ("V", "V_ref"))
        axes[0, 0].plot(s, V, color=colour, lw=2.4, label=f"V: {name}")
        axes[0, 0].plot(s, V_ref, color=colour, lw=1.8, ls="--", label=f"reference: {name}")
        words = f"{name}: RMSE {number(mean_figure(laps, 'velocity_rmse'))} m/s"
        axes[1, 0].plot(s, mean_curve(laps, s, deviation), color=colour, lw=2.4, label=words)
    axes[1, 0].axhline(0, color="0.4", lw=0.7)
    axes[0, 0].set_ylabel("speed V [m/s]")
    axes[1, 0].set_ylabel("V less its reference [m/s]")
    axes[1, 0].set_xlabel("arc length s along the planned path, drift section [m]")
    axes[1, 0].set_xlim(start, end)
    for axis in axes[:, 0]:
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    axes[0, 0].set_title(f"{CONTROLLERS.get(controller, controller)}: speed tracking in the drift")
    figure.align_ylabels()
    return figure
