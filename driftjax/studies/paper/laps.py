"""Compute figures of the laps of a run, per plant."""

import numpy as np
import xarray as xr

from driftjax.store import RunFolder

ENTRY = 1 / 3  # of the drift section: what is lost before there was made while entering


def per_plant(data: xr.Dataset, controller: str, section: tuple[float, float]) -> dict[str, np.ndarray]:
    """Return every figure of one controller's laps in a stage (SI): means over noise seeds, one per plant.

    RMSE and the parts of the lateral error are over the part of the section driven by the drift controller; lap times
    are those of completed laps, NaN for plants without one.
    """
    batch = data.isel(lane=np.flatnonzero(data["controller"].values == controller))
    rows = [_lap(batch.isel(lane=i), section) for i in range(batch.sizes["lane"])]
    plants = batch["plant"].values
    of = {
        plant: [row for row, name in zip(rows, plants, strict=True) if name == plant] for plant in dict.fromkeys(plants)
    }
    return {name: np.array([_mean([row[name] for row in laps]) for laps in of.values()]) for name in rows[0]}


def driven_steps(lap: xr.Dataset, section: tuple[float, float]) -> np.ndarray:
    """Return the steps of one lap that the drift controller drove in the section."""
    s = lap["s"].values
    return lap["alive"].values & lap["drifting"].values & (s >= section[0]) & (s <= section[1])


def _mean(values: list[float]) -> float:
    """Return the mean of the finite values; NaN where there are none."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")


def _lap(lap: xr.Dataset, section: tuple[float, float]) -> dict[str, float]:
    at = {name: lap[name].values for name in ("s", "e", "beta", "beta_ref", "r", "r_ref", "e_ref")}
    inside = driven_steps(lap, section)
    start = inside & (at["s"] <= section[0] + ENTRY * (section[1] - section[0]))
    rms = lambda a, b: _over(inside, (at[a] - at[b]) ** 2) ** 0.5
    completed = bool(lap["completed"].values)
    errors = {name: float(lap[name].values) for name in ("lateral_error", "lateral_error_max", "velocity_rmse")}
    return errors | {
        "beta_rmse": rms("beta", "beta_ref"),
        "r_rmse": rms("r", "r_ref"),
        "lap_time": float(lap["t"].values[lap["alive"].values][-1]) if completed else float("nan"),
        "completed": float(completed),
        "drifted": float(completed and float(lap["drift_share"].values) >= 0.5),
        "entry": _over(start, np.abs(at["e"])),
        "reference": _over(inside, np.abs(at["e_ref"])),
        "tracking": _over(inside, np.abs(at["e"] - at["e_ref"])),
    }


def _over(where: np.ndarray, values: np.ndarray) -> float:
    return float(np.mean(values[where])) if where.any() else float("nan")


def section_of(run: RunFolder) -> tuple[float, float]:
    """Return the first and last arc length of the planned drift section [m]."""
    plan = run.read_dataset("plan.nc")
    return float(plan.attrs["drift_start"]), float(plan.attrs["drift_end"])
