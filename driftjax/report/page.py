"""Write all figures of a run, and one HTML page with them."""

from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

from driftjax.report.comparison import plot_comparison
from driftjax.report.exploration import plot_gp_data, plot_speed_sets
from driftjax.report.html import collapsible, document, image, preformatted
from driftjax.report.laps import drift_controllers
from driftjax.report.plan import plot_states, plot_trajectory
from driftjax.report.posture import plot_posture
from driftjax.report.style import save
from driftjax.report.table import results_table
from driftjax.report.tracking import plot_lateral_error, plot_velocity
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle

TITLES = {
    "comparison": "Lateral error of all stages", "plan_trajectory": "Planned trajectory",
    "plan_states": "Planned states", "lateral_error": "Lateral error", "velocity": "Speed tracking",
    "posture": "Posture in the corner", "speed_sets": "Speed sets of the active explorer",
    "gp_data": "Data of the Gaussian process",
}  # fmt: skip


def learn_figures(run: RunFolder) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of everything that the run has data for."""
    if run.has("results.json") and (figure := plot_comparison(run.read_json("results"))):
        yield "comparison", figure
    if not run.has("plan.nc"):
        return
    plan = run.read_dataset("plan.nc")
    yield "plan_trajectory", plot_trajectory(plan)
    yield "plan_states", plot_states(plan)
    vehicle = load_vehicle(str(run.config["vehicle"]))
    for controller in drift_controllers(run):
        drawn = {
            "lateral_error": plot_lateral_error(run, plan, controller),
            "posture": plot_posture(run, plan, controller, vehicle),
            "velocity": plot_velocity(run, plan, controller),
            "speed_sets": plot_speed_sets(run, controller),
            "gp_data": plot_gp_data(run, controller),
        }
        yield from ((f"{name}_{controller}", figure) for name, figure in drawn.items() if figure is not None)


def write_report(run: RunFolder) -> Path:
    """Write figures/*.png and .pdf, table.txt and report.html from the folder alone; returns the page's path.

    A run that stopped early is shown as far as it got.
    """
    pictures = [save(figure, run.path / "figures", name) for name, figure in learn_figures(run)]
    words = results_table(run.read_json("results")) if run.has("results.json") else f"finished so far: {run.finished()}"
    (run.path / "table.txt").write_text(words + "\n", encoding="utf-8")
    page = run.path / "report.html"
    page.write_text(_html(run, words, pictures), encoding="utf-8")
    return page


def _html(run: RunFolder, words: str, pictures: list[Path]) -> str:
    parts = [preformatted(words), *(image(path, figure_title(path.stem)) for path in pictures)]
    parts += [collapsible("Configuration", run.config), collapsible("Versions", run.read_json("versions"))]
    return document(f"driftjax learn: {run.config.get('car', '')}", run.created, parts)


def figure_title(name: str) -> str:
    """Return the heading of the figure `name`."""
    key = next(key for key in TITLES if name.startswith(key))
    controller = name.removeprefix(key).strip("_")
    return TITLES[key] + (f", controller: {controller}" if controller else "")
