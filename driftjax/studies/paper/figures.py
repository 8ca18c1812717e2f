"""Draw the comparison, one figure per car."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from driftjax.report.style import CONTROLLERS, EXPLORED, GPR, NOMINAL, new_figure, save
from driftjax.studies.paper.credit import CONTRASTS, SQUARE, WATERFALL
from driftjax.studies.paper.exploration import CHOOSERS, OURS
from driftjax.studies.paper.statistics import ALONE, METHODS, TARGETS

COLOURS = {"paper": GPR, "path": EXPLORED, "alone": NOMINAL}
SHIFT = {"paper": -0.16, "path": 0.16}


def write_figures(results: dict[str, Any], folder: Path) -> list[Path]:
    """Write `statistics_<car>`, `laps_<car>`, `credit_<car>` as .png and .pdf where they have content; return PNGs."""
    cars = results["cars"].items()
    compared = [_draw(car, result, folder) for car, result in cars if "methods" in result]
    credits = {car: {who: one for who, one in result["credit"].items() if "interaction" in one and
                     all(step in one["contrasts"] for step in WATERFALL)} for car, result in cars}  # fmt: skip
    compared += [_draw_choosers(car, result["choosers"], folder) for car, result in cars if result.get("choosers")]
    return compared + [_draw_credit(car, credited, folder) for car, credited in credits.items() if credited]


def _draw(car: str, result: dict[str, Any], folder: Path) -> Path:
    columns = 2 if result["ablations"] else 1
    figure, axes = new_figure(2, columns, (7.0 * columns, 8.0))
    _methods(axes[0, 0], result["methods"])
    _gains(axes[1, 0], result, TARGETS[car])
    if result["ablations"]:
        _ablations(axes[0, 1], result["ablations"], "gpr-best", "GPR, best setting again")
        _ablations(axes[1, 1], result["ablations"], "explore-best", "explored, best setting again")
    figure.suptitle(f"{car}: means and 95 % intervals over plants")
    figure.legend(loc="outside lower center", ncols=3)
    return save(figure, folder, f"statistics_{car}")


def _point(axis: Axes, y: float, cell: dict[str, Any], who: str, label: str | None = None) -> None:
    """Draw a mean with its interval, and the plants where available."""
    mean = cell.get("mean", cell.get("value"))
    if mean is None:
        return
    low, high = cell["ci95"]
    colour = COLOURS[who]
    values = [value for value in cell.get("per_plant", []) if value is not None]
    axis.plot(values, [y] * len(values), "|", color=colour, alpha=0.35, ms=7, zorder=2)
    if low is not None:
        axis.plot([low, high], [y, y], color=colour, lw=2.2, zorder=3)
    axis.plot([mean], [y], "o", color=colour, ms=5, zorder=4, label=label)


def _named(axis: Axes, words: list[str]) -> None:
    axis.set_yticks(range(len(words)), words)
    axis.set_ylim(len(words) - 0.5, -0.5)
    axis.grid(False, axis="y")


def _log(axis: Axes) -> None:
    """Set up a logarithmic error axis: errors differ by factors; ticks at 1, 2 and 5 keep labels apart."""
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_xlabel("mean lateral error [m]")


def _methods(axis: Axes, methods: dict[str, Any]) -> None:
    names = [name for name in METHODS if any(name in stages for stages in methods.values())]
    for who, stages in methods.items():
        for y, name in enumerate(names):
            if name in stages and (name not in ALONE or who == "paper"):
                label = CONTROLLERS[who] if name == "nominal" else None
                cell = stages[name]["lateral_error"]
                _point(axis, y, cell, "alone") if name in ALONE else _point(axis, y + SHIFT[who], cell, who, label)
    _named(axis, [METHODS[name].replace(", ", ",\n") for name in names])
    _log(axis)
    axis.set_title("ticks: plants")


def _gains(axis: Axes, result: dict[str, Any], aims: dict[str, float]) -> None:
    words = {
        "gpr": "lateral error, GPR\nagainst nominal",
        "exploration": "lateral error, explored\nagainst GPR",
        "exploration_velocity": "speed RMSE, explored\nagainst GPR",
    }
    for y, name in enumerate(words):
        for who in result["gains"]:
            _point(axis, y + SHIFT[who], result["gains"][who][name], who)
        label = "Wu et al. 2025" if y == 0 else None
        axis.plot([aims[name]], [y], "D", color="black", mfc="none", ms=8, label=label, zorder=5)
    _named(axis, list(words.values()))
    axis.axvline(0, color="black", lw=0.8)
    axis.set_xlabel("reduction [%]")


def _ablations(axis: Axes, ablations: dict[str, Any], end: str, title: str) -> None:
    for y, one in enumerate(ablations.values()):
        for who, stages in one["methods"].items():
            if end in stages:
                _point(axis, y + SHIFT[who], stages[end]["lateral_error"], who)
    _named(axis, [one["words"] for one in ablations.values()])
    _log(axis)
    axis.set_title(title)


def _draw_credit(car: str, credit: dict[str, Any], folder: Path) -> Path:
    """Draw per controller the waterfall from nominal to explored and the interaction of speed and correction."""
    figure, axes = new_figure(len(credit), 2, (13.0, 4.2 * len(credit)), width_ratios=(2, 1))
    for row, (who, credited) in zip(axes, credit.items(), strict=True):
        _waterfall(row[0], credited)
        _interaction(row[1], credited)
        row[0].set_title(CONTROLLERS[who])
    figure.suptitle(f"{car}: who owns the gain; means and 95 % intervals over plants, of steps paired")
    return save(figure, folder, f"credit_{car}")


def _draw_choosers(car: str, choosers: dict[str, Any], folder: Path) -> Path:
    """Draw the error of the best lap so far against the number of exploration laps, with bands over plants."""
    figure, axes = new_figure(1, len(choosers), (6.5 * len(choosers), 4.6))
    for axis, (who, cell) in zip(axes[0], choosers.items(), strict=True):
        laps = range(len(next(iter(cell["curves"].values()))["error"]))
        for at, (name, curve) in enumerate(cell["curves"].items()):
            colour = EXPLORED if name == OURS else f"C{at}"
            axis.plot(laps, [one["mean"] for one in curve["error"]], "o-", color=colour, label=CHOOSERS[name],
                      zorder=3 if name == OURS else 2)  # fmt: skip
            if name in (OURS, "planned") and curve["error"][0]["ci95"][0] is not None:
                low, high = zip(*(one["ci95"] for one in curve["error"]), strict=True)
                axis.fill_between(laps, low, high, color=colour, alpha=0.12, lw=0)
        axis.set_ylim(bottom=0.0)
        axis.set_xticks(laps)
        axis.set_xlabel("exploration laps")
        axis.set_ylabel("lateral error of the best lap so far [m]")
        axis.set_title(CONTROLLERS[who])
    axes[0, -1].legend()
    figure.suptitle(f"{car}: means over plants; bands are 95 % intervals of two of the rules")
    return save(figure, folder, f"laps_{car}")


def _waterfall(axis: Axes, credited: dict[str, Any]) -> None:
    level = {name: variant["lateral_error"]["mean"] for name, variant in credited["rungs"].items()}
    axis.barh(0, level["nominal"], color=NOMINAL)
    for y, step in enumerate(WATERFALL, start=1):
        _, before, after = CONTRASTS[step]
        better = level[after] <= level[before]
        axis.barh(y, level[after] - level[before], left=level[before], color=GPR if better else EXPLORED)
        low, high = credited["contrasts"][step]["metres"]["ci95"]
        if low is not None:
            axis.plot([level[before] + low, level[before] + high], [y, y], color="black", lw=1.2)
        axis.plot([level[before]] * 2, [y - 1, y], color="black", lw=0.6)
    axis.barh(len(WATERFALL) + 1, level["all"], color=NOMINAL)
    _named(axis, ["nominal MPC", *(CONTRASTS[step].words for step in WATERFALL), "explored"])
    axis.margins(x=0.03)
    axis.set_xlim(left=0.0)
    axis.set_xlabel("mean lateral error [m]; blue: less, red: more")


def _interaction(axis: Axes, credited: dict[str, Any]) -> None:
    for correction, colour, shift in (("off", NOMINAL, -0.03), ("on", EXPLORED, 0.03)):
        cells = [credited["rungs"][SQUARE[speed, correction]]["lateral_error"] for speed in ("planned", "sets")]
        x = [shift, 1 + shift]
        axis.plot(x, [cell["mean"] for cell in cells], "o-", color=colour, label=f"correction of the path {correction}")
        for at, cell in zip(x, cells, strict=True):
            if cell["ci95"][0] is not None:
                axis.plot([at, at], cell["ci95"], color=colour, lw=1.0)
    axis.set_xticks([0, 1], ["planned speed", "V-sets"])
    axis.set_xlim(-0.4, 1.4)
    axis.set_ylim(bottom=0.0)
    axis.set_ylabel("mean lateral error [m]")
    axis.legend()
