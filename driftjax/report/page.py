"""All figures of a run, and one HTML page that holds them."""

from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

from driftjax.report.comparison import comparison
from driftjax.report.exploration import gp_data, speed_sets
from driftjax.report.html import document, folded, picture, text
from driftjax.report.laps import controllers_of
from driftjax.report.plan import states, trajectory
from driftjax.report.posture import posture
from driftjax.report.style import save
from driftjax.report.table import table
from driftjax.report.tracking import lateral_error, velocity
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle

TITLES = {
    "comparison": "Lateral error of all stages", "plan_trajectory": "Planned trajectory",
    "plan_states": "Planned states", "lateral_error": "Lateral error", "velocity": "Speed tracking",
    "posture": "Posture in the corner", "speed_sets": "Speed sets of the active explorer",
    "gp_data": "Data of the Gaussian process",
}  # fmt: skip


def figures(run: RunFolder) -> Iterator[tuple[str, Figure]]:
    """Name and figure of everything that the run has data for."""
    if run.has("results.json") and (figure := comparison(run.read_json("results"))):
        yield "comparison", figure
    if not run.has("plan.nc"):
        return
    plan = run.read_dataset("plan.nc")
    yield "plan_trajectory", trajectory(plan)
    yield "plan_states", states(plan)
    vehicle = load_vehicle(str(run.config["vehicle"]))
    for controller in controllers_of(run):
        drawn = {
            "lateral_error": lateral_error(run, plan, controller),
            "posture": posture(run, plan, controller, vehicle),
            "velocity": velocity(run, plan, controller),
            "speed_sets": speed_sets(run, controller),
            "gp_data": gp_data(run, controller),
        }
        yield from ((f"{name}_{controller}", figure) for name, figure in drawn.items() if figure is not None)


def write_report(run: RunFolder) -> Path:
    """Write figures/*.png and .pdf, table.txt and report.html from the folder alone; returns the page's path.

    Where a run stopped early, what it has is shown.
    """
    pictures = [save(figure, run.path / "figures", name) for name, figure in figures(run)]
    words = table(run.read_json("results")) if run.has("results.json") else f"finished so far: {run.finished()}"
    (run.path / "table.txt").write_text(words + "\n", encoding="utf-8")
    page = run.path / "report.html"
    page.write_text(_html(run, words, pictures), encoding="utf-8")
    return page


def _html(run: RunFolder, words: str, pictures: list[Path]) -> str:
    parts = [text(words), *(picture(path, title(path.stem)) for path in pictures)]
    parts += [folded("Configuration", run.config), folded("Versions", run.read_json("versions"))]
    return document(f"driftjax learn: {run.config.get('car', '')}", run.created, parts)


def title(name: str) -> str:
    """Heading of the figure called `name`."""
    key = next(key for key in TITLES if name.startswith(key))
    controller = name.removeprefix(key).strip("_")
    return TITLES[key] + (f", controller: {controller}" if controller else "")
