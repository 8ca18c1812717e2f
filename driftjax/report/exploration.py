"""Plot exploration: the speed sets, and the GP's data before and after."""

import numpy as np
from matplotlib.figure import Figure

from driftjax.report.laps import stages_by_kind
from driftjax.report.style import CONTROLLERS, EXPLORED, GPR, legend_below, new_figure, panel_grid, stage_label
from driftjax.store import RunFolder

PANELS = 4  # plants shown at most


def plot_speed_sets(run: RunFolder, controller: str) -> Figure | None:
    """Plot the V-sets of the first explored stage: origin, trend, bounds and generated speeds, a panel per plant."""
    name = next((stage for stage in run.finished() if stage.startswith("explore-")), None)
    data = run.read_stage(name) if name else None
    if data is None or "vset_V" not in data:
        return None
    lanes = np.flatnonzero(data["controller"].values == controller)[:PANELS]
    if not lanes.size:
        return None
    figure, panels = panel_grid(len(lanes), 2, 4.8, 3.4, sharex=True, sharey=True)
    for axis, lane in zip(panels, lanes, strict=True):
        one = data.isel(lane=int(lane))
        s, origin = one["vset_s"].values, one["vset_origin"].values
        bounds = one["vset_lower"].values, one["vset_upper"].values
        axis.fill_between(s, *bounds, color="0.88", lw=0, label="widest bounds")
        axis.plot(s, origin, color=GPR, lw=2.2, label="initial speed")
        low, high = bounds[0].min(), bounds[1].max()
        trend = origin + one["vset_target"].values
        axis.plot(s, trend, color=EXPLORED, lw=1.8, label="initial speed + trend r_b e")
        for k, V in enumerate(one["vset_V"].values):
            axis.plot(s, V, color=GPR, lw=1.2, ls="--", label="generated speeds" if k == 0 else None)
        reach = 0.35 * max(high - low, 1e-3)  # shown beyond the bounds; thrice this where the trend goes there
        below = np.clip(trend.min(), low - 3 * reach, low - reach)
        axis.set_ylim(float(below), float(np.clip(trend.max(), high + reach, high + 3 * reach)))
        axis.margins(x=0)
        axis.label_outer()
        axis.set_title(f"plant {one['plant'].values}")
    for axis in panels[-2:]:
        axis.tick_params(labelbottom=True)
        axis.set_xlabel("arc length s along the planned path [m]")
    for axis in panels[::2]:
        axis.set_ylabel("speed V [m/s]")
    legend_below(figure, panels[0], 4)
    figure.suptitle(f"{CONTROLLERS.get(controller, controller)}: speed sets of {stage_label(str(name))}", fontsize=10.5)
    return figure


def _points(run: RunFolder, stage: str, controller: str) -> np.ndarray:
    """Return the GP inputs (points, 5) of all plants."""
    data = run.read_stage(stage)
    if "gp_Z" not in data:
        return np.zeros((0, 5))
    mine = data["controller"].values == controller
    return data["gp_Z"].values[mine][data["gp_mask"].values[mine].astype(bool)]


def plot_gp_data(run: RunFolder, controller: str) -> Figure | None:
    """Plot the GP's data in speed, sideslip and yaw rate, before and after exploration."""
    last = [names[-1] for kind, names in stages_by_kind(run).items() if kind != "nominal"]
    sets = {name: _points(run, name, controller) for name in last}
    if len(sets) < 2 or not all(len(points) for points in sets.values()):
        return None
    figure, axes = new_figure(1, 2, (9.0, 4.3), sharex=True)
    before, after = sets
    styles = {after: {"edgecolors": EXPLORED, "s": 26, "facecolors": "none", "linewidths": 0.9, "alpha": 0.7},
              before: {"color": GPR, "s": 11, "alpha": 0.75, "linewidths": 0}}  # fmt: skip
    rows = ((1, "sideslip beta [deg]"), (2, "yaw rate r [deg/s]"))
    for axis, (column, label) in zip(axes[0], rows, strict=True):
        for name, style in styles.items():
            words = "before exploration" if name == before else "after exploration"
            points = sets[name]
            words += f" ({stage_label(name)}, {len(points)} points)"
            axis.scatter(points[:, 0], np.rad2deg(points[:, column]), label=words, **style)
        axis.set(xlabel="speed V [m/s]", ylabel=label)
    legend_below(figure, axes[0, 0], 2)
    label = CONTROLLERS.get(controller, controller)
    figure.suptitle(f"{label}: data of the Gaussian process, all plants", fontsize=10.5)
    return figure
