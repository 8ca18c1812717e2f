"""Plot a sweep: main effects and interactions, parallel coordinates, Pareto front, shares of the variance."""

from itertools import combinations
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from driftjax.core.intervals import half_width
from driftjax.report.style import EXPLORED, GPR, NOMINAL, new_figure, panel_grid, save
from driftjax.sweep.analysis import Analysis, Shares, groups_of
from driftjax.sweep.config import Range

PAIRS, LINES = 6, 500  # pairs of fields shown, trials drawn


def write_figures(analysis: Analysis, shares: Shares | None, folder: Path) -> list[Path]:
    """Write all figures that the trials allow, as PNG and PDF; returns the paths of the PNGs."""
    if len(analysis.objective) < 2:
        return []
    paths = [plot_main_effects(analysis, folder), plot_parallel_coordinates(analysis, folder)]
    if len(analysis.values) > 1:
        paths.append(plot_interactions(analysis, shares, folder))
    if np.isfinite(analysis.second).any():
        paths.append(plot_pareto(analysis, folder))
    return [*paths, plot_sensitivity(shares, analysis, folder)] if shares else paths


def _log(analysis: Analysis, name: str) -> bool:
    options = analysis.config.varied[name]
    return isinstance(options, Range) and options.log


def _label(analysis: Analysis, name: str, axis: Axes) -> None:
    axis.set_xlabel(name)
    if name in analysis.labels:
        axis.set_xticks(range(len(analysis.labels[name])), analysis.labels[name])
    elif _log(analysis, name):
        axis.set_xscale("log")


def plot_main_effects(analysis: Analysis, folder: Path) -> Path:
    """Plot the objective over each field: trials, and means with 95 % intervals of the mean."""
    names = list(analysis.values)
    figure, panels = panel_grid(len(names), 3, 3.4, 2.8)
    for axis, name in zip(panels, names, strict=True):
        x, place = analysis.values[name], groups_of(analysis.values[name])
        axis.plot(x, analysis.objective, ".", color=NOMINAL, alpha=0.35, ms=4, zorder=1)
        groups = [place == k for k in np.unique(place)]
        middle = [np.median(x[group]) for group in groups]
        mean = [analysis.objective[group].mean() for group in groups]
        half = [half_width(analysis.objective[group]) for group in groups]
        axis.errorbar(middle, mean, half, color=EXPLORED, marker="o", ms=4, capsize=2, zorder=2)
        axis.set_ylabel(analysis.config.objective)
        _label(analysis, name, axis)
    return save(figure, folder, "main_effects")


def plot_interactions(analysis: Analysis, shares: Shares | None, folder: Path) -> Path:
    """Plot the mean objective over pairs of fields, those with the largest interaction first."""
    share = lambda pair: (shares or {}).get(" with ".join(pair), (0.0,))[0]
    pairs = sorted(combinations(analysis.values, 2), key=share, reverse=True)[:PAIRS]
    figure, panels = panel_grid(len(pairs), 3, 3.8, 3.2)
    for axis, (a, b) in zip(panels, pairs, strict=True):
        x, y = groups_of(analysis.values[a]), groups_of(analysis.values[b])
        grid = np.full((y.max() + 1, x.max() + 1), np.nan)
        for i, j in {*zip(y.tolist(), x.tolist(), strict=True)}:
            grid[i, j] = analysis.objective[(y == i) & (x == j)].mean()
        image = axis.imshow(grid, origin="lower", aspect="auto", cmap="viridis")
        figure.colorbar(image, ax=axis, label=analysis.config.objective)
        for which, name, place in (("x", a, x), ("y", b, y)):
            middle = [np.median(analysis.values[name][place == k]) for k in range(place.max() + 1)]
            text = [analysis.labels[name][int(m)] if name in analysis.labels else f"{m:.3g}" for m in middle]
            getattr(axis, f"set_{which}ticks")(range(len(text)), text)
            getattr(axis, f"set_{which}label")(name)
        axis.tick_params(axis="x", rotation=45)
        axis.grid(False)
    return save(figure, folder, "interactions")


def plot_parallel_coordinates(analysis: Analysis, folder: Path) -> Path:
    """Plot parallel coordinates: a line per trial over its fields and the objective, better ones darker."""
    columns = {**analysis.values, analysis.config.objective: analysis.objective}
    figure, axes = new_figure(1, 1, (1.6 * len(columns) + 2.0, 4.0))
    axis, colours = axes[0, 0], plt.get_cmap("viridis")
    some = np.unique(np.linspace(0, len(analysis.objective) - 1, min(LINES, len(analysis.objective))).astype(int))
    rank = np.argsort(np.argsort(analysis.objective)) / max(1, len(analysis.objective) - 1)
    scaled = []
    for position, (name, values) in enumerate(columns.items()):
        shown = np.log(values) if name in analysis.values and _log(analysis, name) else values
        low, span = shown.min(), np.ptp(shown) or 1.0
        scaled.append((shown - low) / span)
        places = np.unique(shown) if name in analysis.labels else np.unique([shown.min(), shown.max()])
        for place in places:
            value = values[shown == place][0]
            text = analysis.labels[name][int(value)] if name in analysis.labels else f"{value:.3g}"
            axis.text(position, (place - low) / span, f" {text}", fontsize=8, va="center", zorder=3)
    for i in some[::-1]:
        axis.plot(range(len(columns)), [column[i] for column in scaled], color=colours(rank[i]), lw=0.8, alpha=0.6)
    axis.set_xticks(range(len(columns)), list(columns), rotation=20)
    axis.set_yticks([])
    return save(figure, folder, "parallel_coordinates")


def plot_pareto(analysis: Analysis, folder: Path) -> Path:
    """Plot the objective against the second figure, with the Pareto front."""
    figure, axes = new_figure(1, 1, (4.6, 3.6))
    axis, front = axes[0, 0], analysis.front
    axis.plot(analysis.objective, analysis.second, ".", color=NOMINAL, alpha=0.4, label="trials")
    best = (analysis.objective[front], analysis.second[front])
    axis.step(*best, "o-", where="post", color=EXPLORED, ms=4, label="Pareto front")
    axis.set_xlabel(analysis.config.objective)
    axis.set_ylabel(analysis.config.second)
    axis.legend()
    return save(figure, folder, "pareto")


def plot_sensitivity(shares: Shares, analysis: Analysis, folder: Path) -> Path:
    """Plot the share of the objective's variance that each field explains by itself, and pairs beyond that."""
    order = sorted(shares, key=lambda name: shares[name][0])
    share, low, high = np.array([shares[name] for name in order]).T
    figure, axes = new_figure(1, 1, (5.4, 0.35 * len(order) + 1.2))
    axis = axes[0, 0]
    axis.barh(order, share, color=[EXPLORED if " with " in name else GPR for name in order])
    axis.errorbar(share, range(len(order)), xerr=[share - low, high - share], fmt="none", color=NOMINAL, capsize=2)
    axis.set_xlabel(f"share of the variance of {analysis.config.objective} [-]")
    return save(figure, folder, "sensitivity")
