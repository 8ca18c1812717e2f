"""Tables, figure and page of a comparison of two logs, from the run folder alone."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from driftjax.core import write_text
from driftjax.logs.columns import MEASURED
from driftjax.report.html import (
    collapsible,
    document,
    figures,
    image,
    paragraph,
    quantities,
    quantity,
    section,
    table,
)
from driftjax.report.style import EXPLORED, GPR, NOMINAL, OTHER, legend_below, new_figure, save
from driftjax.report.table import aligned, number, with_interval
from driftjax.store import RunFolder

CARS = {"nominal": "nominal car", "other": "car of {other}", "corrected": "car of {other} with the named differences",
        "own": "car of {here}"}  # fmt: skip
COLOURS = {"nominal": NOMINAL, "other": EXPLORED, "corrected": GPR, "own": OTHER}
TITLE = "Errors on each log"
WORDS = ("Open-loop errors over those of the log's own car, with 95 % intervals over blocks of time. Own and corrected "
         "car are fitted without the part of the log that they predict.")  # fmt: skip


def difference_rows(content: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return every parameter that differs, in A and in B with standard errors; head first."""
    rows: list[tuple[str, ...]] = [("difference", "in A", "in B", "B less A", "unit", "P", "p", "family", "instead")]
    for one in content["differences"]:
        rivals = ", ".join(f"{name} ({p:.2f})" for name, p in one["rivals"].items())
        for name, row in one["parameters"].items():
            a, b = (f"{row[k]:.4g} +- {row[f'{k}_error']:.2g}" for k in "ab")
            end = " (at its bound)" if row["at_bound"] else ""
            rows.append((f"{one['effect']}.{name}{end}", a, b, with_interval(row["difference"], row["ci95"], ".4g"),
                         row["unit"], f"{one['probability']:.2f}", f"{one['p_value']:.2g}", one["family"],
                         rivals or "-"))  # fmt: skip
    return rows


def gap_rows(gap: dict[str, Any], here: str) -> list[tuple[str, ...]]:
    """Return the errors on log `here` (A or B) per car and horizon, and their ratios to those of its own car."""
    rows: list[tuple[str, ...]] = [
        ("predicted by", "after [s]", "V [m/s]", "beta [rad]", "r [rad/s]", *(f"{c} over own" for c in MEASURED),
         "all over own"),
    ]  # fmt: skip
    for name, words in CARS.items():
        for i, horizon in enumerate(gap["horizons_s"]):
            values = (number(gap["rmse"][name][c][i], ".4f") for c in MEASURED)
            ratio = (with_interval(gap["ratio_to_own"][name][c][i], gap["ratio_ci95"][name][c][i])
                     for c in (*MEASURED, "all"))  # fmt: skip
            rows.append((car_words(words, here), f"{horizon:.3g}", *values, *ratio))
    return rows


def car_words(words: str, here: str) -> str:
    """Return the name of a car on the log `here`."""
    return words.format(here=here, other="BA"["AB".index(here)])


def gap_notes(gap: dict[str, Any]) -> str:
    """Return how the own car was fitted."""
    if gap["held_out"]:
        return "own and corrected car: fitted without the part of the log that they predict"
    return "own and corrected car: fitted to the whole log, which is too short to leave any part out"


def range_rows(content: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the ranges of every channel in both logs and their overlap; head first."""
    ends = lambda pair: " to ".join(f"{end:.3g}" for end in pair)
    return [("channel", "in A", "in B", "shared")] + [
        (name, ends(one["first"]), ends(one["second"]), f"{100 * one['share']:.0f} %")
        for name, one in content["overlap"].items()
    ]


def comparison_text(content: dict[str, Any]) -> str:
    """Format the tables of a comparison as text; empty where the logs are too short."""
    parts = []
    if content["differences"]:
        parts.append([*aligned(difference_rows(content)), "in A, in B: with standard error; B less A: 95 % interval"])
    if content["gap"]:
        for here in "BA":
            gap = content["gap"][here.lower()]
            parts.append([f"open-loop error (RMS) on {here}", *aligned(gap_rows(gap, here)), gap_notes(gap)])
        parts.append(["ranges, 5th to 95th percentile (SI)", *aligned(range_rows(content))])
    return "\n\n".join("\n".join(part) for part in parts) + "\n" if parts else ""


def plot_gap(content: dict[str, Any]) -> Figure:
    """Plot the errors of every car over those of the log's own car, per channel, at the decisive horizon."""
    figure, axes = new_figure(1, 2, (9.5, 3.8), sharey=True)
    channels = (*MEASURED, "all")
    for axis, here in zip(axes[0], "BA", strict=True):
        gap = content["gap"][here.lower()]
        at = gap["horizons_s"].index(gap["decisive_horizon_s"])
        for k, (name, words) in enumerate(CARS.items()):
            value = np.array([_or_nan(gap["ratio_to_own"][name][c][at]) for c in channels])
            ends = np.array([[_or_nan(end) for end in gap["ratio_ci95"][name][c][at]] for c in channels])
            place = np.arange(len(channels)) + 0.17 * (k - 1.5)
            axis.bar(place, value, 0.16, color=COLOURS[name], label=car_words(words, here) if here == "B" else None)
            axis.errorbar(place, value, np.abs(ends.T - value), fmt="none", ecolor="black", lw=0.8)
        axis.set_xticks(range(len(channels)), channels)
        axis.axhline(1, color="0.6", lw=0.8)
        axis.set_title(f"predicting {here}, {gap['decisive_horizon_s']:.2g} s ahead")
    axes[0, 0].set_ylabel("error over that of its own car [-]")
    legend_below(figure, axes[0, 0], 4)
    return figure


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def write_comparison(folder: RunFolder | str | Path) -> Path:
    """Write figures/gap.png, .pdf and report.html of a comparison of logs from its folder; return the page's path."""
    run = RunFolder.open(folder)
    content, page = run.read_json("compare"), run.path / "report.html"
    pictures = [save(plot_gap(content), run.path / "figures", "gap")] if content["gap"] else []
    text = log_comparison_page(run, content, pictures)
    write_text(page, text)
    return page


def log_comparison_page(run: RunFolder, content: dict[str, Any], pictures: list[Path]) -> str:
    """Return the page of a comparison."""
    source = paragraph("Source: compare.json, verdict and sentence.", "source")
    parts = [section(f"Verdict: {content['verdict']}", [paragraph(content["sentence"], "lead"), source])]
    if content["differences"]:
        head, *rows = difference_rows(content)
        words = "B less A: with 95 % interval; in A and in B: with standard error. Source: compare.json, differences."
        parts.append(section("What differs", [table(head, quantities(rows, "compare.json: differences"), words)]))
    for here in "BA" if content["gap"] else "":
        gap, key = content["gap"][here.lower()], f"compare.json: gap.{here.lower()}"
        head, *rows = gap_rows(gap, here)
        keys = (key, f"{key}.horizons_s", *[f"{key}.rmse"] * 3, *[f"{key}.ratio_to_own"] * 4)
        cells = [list(map(quantity, row, keys)) for row in rows]
        words = f"RMS error of open-loop predictions of {here}; {gap_notes(gap)}. Source: {key}."
        parts.append(section(f"Errors on {here}", [table(head, cells, words)]))
    if content["overlap"]:
        head, *rows = range_rows(content)
        words = "5th to 95th percentile (SI), and the share of their distributions that the logs have in common. "
        parts.append(
            section(
                "Ranges",
                [table(head, quantities(rows, "compare.json: overlap"), words + "Source: compare.json, overlap.")],
            )
        )
    parts += figures([image(path, TITLE, WORDS) for path in pictures])
    named = (("Data (compare.json, data)", content["data"]), ("Configuration (config.yaml)", run.config),
             ("Versions (versions.json)", run.read_json("versions")))  # fmt: skip
    parts.append(section("How this was made", [collapsible(title, one) for title, one in named]))
    car = run.config.get("vehicle", {}).get("name", "")
    return document(f"driftjax compare: {car}".rstrip(": "), run.created, parts, {})
