"""Summarise the laps of the comparison: figures of every method, gains between them, each with its interval."""

from typing import Any

import numpy as np

from driftjax.learning.metrics import interval, reduction
from driftjax.learning.results import PUBLISHED_REDUCTIONS
from driftjax.store import RunFolder
from driftjax.studies.paper.extrapolation import extrapolated
from driftjax.studies.paper.laps import per_plant, section_of

METHODS = {
    "pursuit": "pure pursuit",
    "lqr": "LQR",
    "nominal": "nominal MPC",
    "single-layer": "GPR in the MPC only, one lap of data",
    "gpr-best": "GPR in reference and MPC, best setting again",
    "explore-best": "explored, best setting again",
}
ALONE = ("pursuit",)  # drivers of their own, whatever the controller
CONTROLLERS = ("paper", "path")
GAINS = {  # name: (before, after, figure)
    "gpr": ("nominal", "gpr-best", "lateral_error"),
    "exploration": ("gpr-best", "explore-best", "lateral_error"),
    "exploration_velocity": ("gpr-best", "explore-best", "velocity_rmse"),
    "all": ("nominal", "explore-best", "lateral_error"),
}
TARGETS: dict[str, dict[str, float]] = {  # of the paper's controller [%]
    car: dict(zip(("gpr", "exploration", "exploration_velocity"), published, strict=True))
    for car, published in PUBLISHED_REDUCTIONS.items()
}
BEST_ERROR = {"sedan": 0.25, "rc": 0.06}  # that the best method is to reach [m]
DRIFTED = 0.95  # of its laps that are to be completed, sideways over half of the section


def compare_methods(run: RunFolder, car: str) -> dict[str, Any]:
    """Return methods, gains, extrapolation and targets of one car."""
    section, stages = section_of(run), {name: run.read_stage(name) for name in run.finished()}
    figures: dict[str, dict[str, dict[str, np.ndarray]]] = {
        who: {
            name: per_plant(data, who if who in data["controller"] else name, section) for name, data in stages.items()
        }
        for who in CONTROLLERS
    }  # in older runs the LQR was a driver of its own
    gains = {who: {name: paired_gain(figures[who], *spec) for name, spec in GAINS.items()} for who in CONTROLLERS}
    beyond = {who: extrapolated(run, who, section) for who in CONTROLLERS}
    return {
        "methods": {who: {name: summarise_figures(rows) for name, rows in figures[who].items()} for who in CONTROLLERS},
        "gains": gains,
        "extrapolation": beyond,
        "targets": targets(car, gains["paper"], figures),
    }


def paired_gain(rows: dict[str, dict[str, np.ndarray]], before: str, after: str, figure: str) -> dict[str, Any]:
    """Return the reduction of a figure from one stage to another [%], paired over plants."""
    if before not in rows or after not in rows:
        return {"value": None, "ci95": [None, None]}
    return reduction(rows[before][figure], rows[after][figure])


def summarise_figures(rows: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return mean and interval of each figure over the plants that have it, and the values of all."""
    return {name: interval(values) | {"per_plant": values.tolist()} for name, values in rows.items()}


def targets(car: str, gains: dict[str, Any], methods: dict[str, dict[str, dict[str, np.ndarray]]]) -> list[dict]:
    """Return each target, its measured value, and whether it is met: gains need an interval that excludes 0."""
    rows = []
    for name, aim in TARGETS[car].items():
        low = gains[name]["ci95"][0]
        met = gains[name]["value"] is not None and gains[name]["value"] >= aim and low is not None and low > 0
        rows.append({"name": name, "aim": aim, **gains[name], "met": met})
    ends = {(who, name): stages[name] for who, stages in methods.items() for name in METHODS if name in stages}
    if not ends:
        return rows
    best = min(ends, key=lambda key: float(ends[key]["lateral_error"].mean()))
    error, drifted = ends[best]["lateral_error"], ends[best]["drifted"]
    rows.append({"name": "best_error", "of": best, "aim": BEST_ERROR[car], "value": float(error.mean()),
                 "ci95": interval(error)["ci95"], "met": bool(error.mean() <= BEST_ERROR[car])})  # fmt: skip
    rows.append({"name": "best_drifted", "of": best, "aim": DRIFTED, "value": float(drifted.mean()),
                 "ci95": interval(drifted)["ci95"], "met": bool(drifted.mean() >= DRIFTED)})  # fmt: skip
    return rows


def ablation_results(run: RunFolder) -> dict[str, Any]:
    """Return figures and gains of an ablation."""
    section, done, controllers = section_of(run), run.finished(), run.config["controllers"]
    stages = {name: run.read_stage(name) for name in ("nominal", "gpr-best", "explore-best") if name in done}
    figures = {who: {name: per_plant(data, who, section) for name, data in stages.items()} for who in controllers}
    return {
        "methods": {who: {name: summarise_figures(rows) for name, rows in figures[who].items()} for who in controllers},
        "gains": {who: {name: paired_gain(figures[who], *GAINS[name]) for name in ("gpr", "exploration", "all")}
                  for who in controllers},
    }  # fmt: skip
