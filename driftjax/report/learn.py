"""Write all figures of a run of `driftjax learn`, and its page."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from driftjax.core import write_text
from driftjax.report.candidates import plot_candidates
from driftjax.report.drives import lap_drives, shown_vehicle, stage_kind
from driftjax.report.exploration import plot_gp_data, plot_speed_sets
from driftjax.report.html import Cell, collapsible, document, figures, image, paragraph, section, stage_for, table
from driftjax.report.laps import drift_controllers
from driftjax.report.plan import plot_states, plot_trajectory
from driftjax.report.player import player_data
from driftjax.report.posture import plot_posture
from driftjax.report.stage_comparison import plot_comparison
from driftjax.report.style import save, stage_label
from driftjax.report.table import CONTROLLERS, HEAD, REDUCTIONS, format_interval, number, result_row, results_table
from driftjax.report.tracking import plot_lateral_error, plot_velocity
from driftjax.store import RunFolder

TITLES = {
    "comparison": "Lateral error of all stages",
    "plan_trajectory": "Planned trajectory",
    "plan_states": "Planned states",
    "lateral_error": "Lateral error",
    "velocity": "Speed tracking",
    "posture": "Posture in the corner",
    "speed_sets": "Speed sets of the active explorer",
    "candidates": "Predicted errors of the candidates",
    "gp_data": "Data of the Gaussian process",
}
KEYS = ("lateral_error", "velocity_rmse", "drift_share")  # numbers of a stage's row, in the order of its table


def learn_figures(run: RunFolder) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of everything that the run has data for."""
    if run.has("results.json") and (figure := plot_comparison(run.read_json("results"))):
        yield "comparison", figure
    if not run.has("plan.nc"):
        return
    plan = run.read_dataset("plan.nc")
    yield "plan_trajectory", plot_trajectory(plan)
    yield "plan_states", plot_states(plan)
    vehicle = shown_vehicle(run)
    for controller in drift_controllers(run):
        figures = {
            "lateral_error": plot_lateral_error(run, plan, controller),
            "posture": plot_posture(run, plan, controller, vehicle),
            "velocity": plot_velocity(run, plan, controller),
            "speed_sets": plot_speed_sets(run, controller),
            "candidates": plot_candidates(run, controller),
            "gp_data": plot_gp_data(run, controller),
        }
        yield from ((f"{name}_{controller}", figure) for name, figure in figures.items() if figure is not None)


def write_report(run: RunFolder) -> Path:
    """Write figures/*.png and .pdf, table.txt and report.html from the folder alone; returns the page's path.

    A run that was stopped is shown up to its last stage.
    """
    pictures = [save(figure, run.path / "figures", name) for name, figure in learn_figures(run)]
    words = results_table(run.read_json("results")) if run.has("results.json") else f"finished so far: {run.finished()}"
    (run.path / "table.txt").write_text(words + "\n", encoding="utf-8")
    page, text = run.path / "report.html", learn_page(run, pictures)
    write_text(page, text)
    return page


def learn_page(run: RunFolder, pictures: list[Path]) -> str:
    """Return the page of a run, with the PNGs `pictures` at its end."""
    results = run.read_json("results") if run.has("results.json") else {}
    player = {"drives": []}
    if run.has("plan.nc"):
        plan = run.read_dataset("plan.nc")
        player = player_data(shown_vehicle(run), lap_drives(run, plan), plan)
    parts = [_summary(run, results)]
    if player["drives"]:
        parts.append(section("Laps", [stage_for("player", "Lap player")], "laps"))
    if results.get("stages"):
        parts.append(
            section("Learning curve", [stage_for("curve", "Learning curve"), _stage_table(results)], "learning")
        )
        parts.append(section("Against the paper", [_reduction_table(results)]))
    parts += figures([image(path, figure_title(path.stem)) for path in pictures])
    parts.append(
        section(
            "How this was made",
            [
                collapsible("Configuration (config.yaml)", run.config),
                collapsible("Versions (versions.json)", run.read_json("versions")),
            ],
        )
    )
    names = [stage["name"] for stage in results.get("stages", ())]
    data = {
        "player": player,
        "results": results,
        "labels": {name: "paper's MPC" if name == "paper" else stage_label(name) for name in names},
        "kinds": {name: stage_kind(name) for name in names},
        "controllers": CONTROLLERS,
    }
    return document(f"driftjax learn: {run.config.get('car', '')}", run.created, parts, data)


def _summary(run: RunFolder, results: dict[str, Any]) -> str:
    """Return what the run achieved, in a sentence per controller."""
    if not results.get("summary"):
        return section(
            "Result", [paragraph(f"Unfinished: stages so far {', '.join(run.finished()) or 'none'}.", "lead")]
        )
    parts = []
    for controller, cell in results["summary"].items():
        steps = [
            f"{words} {number(cell.get(key), '.2f')} m"
            for key, words in (
                ("nominal", "nominal model"),
                ("gpr", "with the learnt Gaussian process"),
                ("explored", "after exploration"),
            )
            if cell.get(key) is not None
        ]
        words = (
            f"Mean distance from the planned path in the drift, {CONTROLLERS.get(controller, controller)} controller: "
        )
        parts.append(paragraph(words + ", ".join(steps) + ".", "lead"))
    parts.append(
        paragraph(
            "Source: results.json, summary.*.nominal, gpr, explored; means over plants of the laps "
            "driven again with new noise.",
            "source",
        )
    )
    return section("Result", parts)


def _stage_table(results: dict[str, Any]) -> str:
    rows = []
    for number_of, stage in enumerate(results["stages"]):
        for controller, cell in stage["controllers"].items():
            key = f"results.json: stages[{number_of}].controllers.{controller}"
            words = result_row(stage["name"], controller, cell)
            means = [(cell.get(name) or {}).get("mean") for name in KEYS]
            done, of = cell.get("completed") or (0, 0)
            numbers = [
                Cell(text, f"{key}.{name}", mean) for text, name, mean in zip(words[2:5], KEYS, means, strict=True)
            ]
            rows.append(
                [
                    Cell(words[0], key, float(number_of)),
                    words[1],
                    *numbers,
                    Cell(words[5], f"{key}.completed", done / of if of else None),
                    Cell(words[6], f"{key}.codes"),
                ]
            )
    return table(
        HEAD,
        rows,
        "Every stage and controller: means over plants, in brackets 95 % intervals of three plants or more. "
        "Source: results.json, stages; each cell names its key.",
    )


def _reduction_table(results: dict[str, Any]) -> str:
    summary = results.get("summary") or {}
    rows = []
    for key, words in REDUCTIONS.items():
        cells = [(summary[controller] or {}).get(key) or {} for controller in summary]
        values = [
            Cell(format_interval(cell, ".1f"), f"results.json: summary.{controller}.{key}", cell.get("value"))
            for controller, cell in zip(summary, cells, strict=True)
        ]
        published = next((cell["paper"] for cell in cells if cell.get("paper") is not None), None)
        rows.append([words, *values, Cell(number(published, ".1f"), f"results.json: summary.*.{key}.paper", published)])
    head = ("reduction [%]", *(str(CONTROLLERS.get(name, name)) for name in summary), "Wu et al. 2025")
    return table(
        head, rows, "Reductions, in brackets 95 % intervals over three plants or more. Source: results.json, summary."
    )


def figure_title(name: str) -> str:
    """Return the heading of the figure `name`."""
    key = next(key for key in TITLES if name.startswith(key))
    controller = name.removeprefix(key).strip("_")
    return TITLES[key] + (f", controller: {controller}" if controller else "")
