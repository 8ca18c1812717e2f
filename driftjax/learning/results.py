"""Summarise a run: figures per stage and controller, and the reductions next to the paper's."""

from typing import Any

import numpy as np
import xarray as xr

from driftjax.learning.metrics import interval, reduction
from driftjax.learning.scenario import Scenario
from driftjax.store.variables import code_names

# Wu et al. 2025, Sec. V: lateral error by GPR, further by exploration, velocity RMSE by exploration [%]
PUBLISHED_REDUCTIONS = {
    "sedan": (52.8, 27.1, 10.6),
    "rc": (36.7, 29.0, 7.2),
}


def results(scenario: Scenario, stages: dict[str, xr.Dataset]) -> dict[str, Any]:
    """Return the content of results.json: one entry per stage, and the summary per controller."""
    config = scenario.config
    entries = [{"name": name, "controllers": _controllers(data)} for name, data in stages.items()]
    summary = {who: _summary(stages, who, config.car) for who in config.controllers}
    return {"car": config.car, "seed": config.seed, "stages": entries, "summary": summary}


def _entries(data: xr.Dataset, controller: str) -> xr.Dataset:
    return data.isel(lane=np.flatnonzero(np.asarray(data["controller"].values) == controller))


def _controllers(data: xr.Dataset) -> dict[str, Any]:
    names = list(dict.fromkeys(np.asarray(data["controller"].values).tolist()))
    return {name: _figures(_entries(data, name)) for name in names}


def _per_plant(data: xr.Dataset, name: str) -> dict[str, float]:
    """Return the mean over noise seeds per plant: seeds of one plant are not independent plants.

    Over the laps that have the figure; NaN for a plant without one.
    """
    plants, values = np.asarray(data["plant"].values), np.asarray(data[name].values, float)
    of = {plant: values[(plants == plant) & np.isfinite(values)] for plant in dict.fromkeys(plants.tolist())}
    return {str(plant): float(some.mean()) if len(some) else float("nan") for plant, some in of.items()}


def _figures(data: xr.Dataset) -> dict[str, Any]:
    codes = np.asarray(data["code"].values)
    names = code_names(data)
    counts = {names[int(code)]: int((codes == code).sum()) for code in np.unique(codes)}
    figure = lambda name: interval(np.array(list(_per_plant(data, name).values())))
    references = {}
    if "reference_found" in data:
        held = np.asarray(data["reference_found"].values)
        references = {"references_found": [int(held.sum()), len(held)]}
    return references | {
        "lateral_error": figure("lateral_error") | {"per_plant": _per_plant(data, "lateral_error")},
        "lateral_error_measured": figure("lateral_error_measured"),
        "velocity_rmse": figure("velocity_rmse"),
        "drift_share": figure("drift_share"),
        "completed": [int(np.asarray(data["completed"].values).sum()), len(codes)],
        "codes": counts,
    }


def _lap(stages: dict[str, xr.Dataset], stage: str, controller: str) -> dict[str, np.ndarray] | None:
    """Return lateral error and velocity RMSE per plant of one stage."""
    if stage not in stages:
        return None
    data = _entries(stages[stage], controller)
    return {name: np.array(list(_per_plant(data, name).values())) for name in ("lateral_error", "velocity_rmse")}


def _summary(stages: dict[str, xr.Dataset], controller: str, car: str) -> dict[str, Any]:
    nominal, gpr, explored = (_lap(stages, name, controller) for name in ("nominal", "gpr-best", "explore-best"))
    paper = PUBLISHED_REDUCTIONS.get(car, (None, None, None))
    error = lambda figures: None if figures is None else float(figures["lateral_error"].mean())
    out: dict[str, Any] = {"nominal": error(nominal), "gpr": error(gpr), "explored": error(explored)}
    pairs = {
        "reduction_gpr": (nominal, gpr, "lateral_error", paper[0]),
        "reduction_exploration": (gpr, explored, "lateral_error", paper[1]),
        "reduction_velocity_rmse": (gpr, explored, "velocity_rmse", paper[2]),
    }
    for name, (before, after, figure, published) in pairs.items():
        if before is None or after is None:
            out[name] = {"value": None, "ci95": [None, None], "paper": published}
        else:
            out[name] = reduction(before[figure], after[figure]) | {"paper": published}
    return out
