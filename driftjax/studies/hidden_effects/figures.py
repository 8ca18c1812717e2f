"""Plot the results of a study: confusion matrix, reliability of probabilities, coverage, gain."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from driftjax.studies.hidden_effects.criteria import BINS, Result, hidden_in
from driftjax.studies.hidden_effects.score import rate_interval
from driftjax.vehicle.effect import EFFECTS

NOTHING = "nothing"


def write_figures(results: list[Result], out: Path) -> list[Path]:
    """Write all figures for which there are data to `out`; return their paths."""
    good = [r for r in results if "error" not in r]
    of_one = [r for r in good if r["case"]["condition"] in ("none", "single")]
    figures = {
        "confusion": plot_confusion(of_one),
        "reliability": plot_reliability([r for r in good if r["case"]["condition"] in ("single", "pair")]),
        "coverage": plot_coverage(good),
        "gain": plot_gain(good),
    }
    paths = []
    for name, figure in figures.items():
        if figure is not None:
            paths.append(out / f"{name}.png")
            figure.savefig(paths[-1], dpi=130)
            plt.close(figure)
    return paths


def plot_confusion(results: list[Result]) -> Figure | None:
    """Plot the hidden effect against the one named first."""
    if not results:
        return None
    labels = [*EFFECTS, NOTHING]
    counts = np.zeros((len(labels), len(labels)))
    for r in results:
        truth, named = [*hidden_in(r), NOTHING][0], [*r["named"], NOTHING][0]
        counts[labels.index(truth), labels.index(named)] += 1
    total = counts.sum(axis=1, keepdims=True)
    figure, axis = plt.subplots(figsize=(13, 12), layout="constrained")
    mesh = axis.imshow(np.where(counts > 0, counts / np.maximum(total, 1), np.nan), cmap="viridis_r", vmin=0, vmax=1)
    for (row, column), count in np.ndenumerate(counts):
        if count:
            dark = count / total[row, 0] > 0.5
            axis.text(column, row, f"{count:.0f}", ha="center", va="center", size=7, color="w" if dark else "k")
    axis.set_xticks(range(len(labels)), labels, rotation=90, fontsize=7)
    axis.set_yticks(range(len(labels)), labels, fontsize=7)
    edges = np.arange(len(labels)) - 0.5
    axis.set_xticks(edges, minor=True)
    axis.set_yticks(edges, minor=True)
    axis.grid(which="minor", color="0.9", linewidth=0.5)
    axis.tick_params(which="minor", length=0)
    axis.set_xlabel("named first")
    axis.set_ylabel("hidden")
    axis.set_title(f"{len(results)} cases with one effect or none (numbers: cases; colour: share of the row)")
    figure.colorbar(mesh, ax=axis, shrink=0.5, label="share of the cases of a row [-]")
    return figure


def plot_reliability(results: list[Result]) -> Figure | None:
    """Plot how often a name with a given probability is right."""
    pairs = np.array([(c["probability"], c["effect"] in hidden_in(r)) for r in results for c in r["causes"]], float)
    if not len(pairs):
        return None
    bins = np.minimum((pairs[:, 0] * BINS).astype(int), BINS - 1)
    figure, axis = plt.subplots(figsize=(5.5, 5), layout="constrained")
    axis.plot([0, 1], [0, 1], color="0.6", linestyle="--", label="calibrated")
    for k in sorted(set(bins.tolist())):
        p, right = pairs[bins == k].T
        low, high = rate_interval(int(right.sum()), len(right))
        rate = right.mean()
        axis.errorbar(p.mean(), rate, [[max(rate - low, 0)], [max(high - rate, 0)]], fmt="o", color="C0", capsize=3)
        axis.annotate(f" {len(right)}", (p.mean(), rate), ha="left", va="top")
    axis.set(
        xlim=(0, 1.08), ylim=(0, 1.08), xlabel="stated probability [-]", ylabel="share of names that are right [-]"
    )
    axis.set_title("Names by their stated probability (numbers: names)")
    axis.legend(loc="upper left")
    return figure


def plot_coverage(results: list[Result]) -> Figure | None:
    """Plot the errors of the parameters of named hidden effects, over the half-width of their 95 % interval."""
    errors: dict[str, list[float]] = {}
    for r in results:
        for one in (one for one in r.get("hidden", ()) if "theta" in one):
            rows = zip(one["strengths"], one["theta"], one["half_width"], strict=True)
            errors.setdefault(one["effect"], []).extend((theta - true) / half for true, theta, half in rows)
    if not errors:
        return None
    names = [name for name in EFFECTS if name in errors]
    every = np.abs(np.concatenate([errors[name] for name in names]))
    figure, axis = plt.subplots(figsize=(7, 0.22 * len(names) + 1.6), layout="constrained")
    axis.axvspan(-1, 1, color="0.9")
    for row, name in enumerate(names):
        axis.plot(errors[name], np.full(len(errors[name]), row), "o", color="C0", markersize=4, alpha=0.7)
    axis.set_yticks(range(len(names)), names, fontsize=7)
    axis.invert_yaxis()
    axis.set_xlabel("error of a parameter over the half-width of its 95 % interval [-]")
    axis.set_title(f"{np.mean(every <= 1):.0%} of {len(every)} intervals hold the truth")
    return figure


def plot_gain(results: list[Result]) -> Figure | None:
    """Plot the share of the explainable error removed by the extended car against that of the true car."""
    compared = [r for r in results if "oracle" in r and "extended" in r["skill"]]
    if not compared:
        return None
    figure, axis = plt.subplots(figsize=(5.5, 5), layout="constrained")
    axis.plot([-0.2, 1], [-0.2, 1], color="0.6", linestyle="--", label="all that can be explained")
    for named, colour, label in ((True, "C0", "something named"), (False, "C1", "nothing named")):
        own = [r for r in compared if bool(r["named"]) == named]
        points = np.array([(r["oracle"][0], r["skill"]["extended"][0]) for r in own]).reshape(-1, 2)
        axis.plot(
            *np.clip(points, -0.2, 1).T, "o", color=colour, markersize=4, alpha=0.7, label=f"{label} ({len(own)})"
        )
    axis.set(xlim=(-0.25, 1.05), ylim=(-0.25, 1.05), xlabel="the true car [-]", ylabel="the extended car [-]")
    axis.set_title("Share of the 1 s error removed on runs held out")
    axis.legend(loc="upper left")
    return figure
