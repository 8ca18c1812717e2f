"""Laps of a stage as rows of plain values, for tables over many runs."""

from typing import Any

import numpy as np
import xarray as xr

from driftjax.store.variables import code_names

LAP_COLUMNS: dict[str, type] = {
    "stage": str,
    "controller": str,
    "plant": str,
    "noise_seed": int,
    "code": str,
    "completed": bool,
    "lateral_error": float,
    "lateral_error_max": float,
    "velocity_rmse": float,
    "drift_share": float,
    "lap_time": float,
}


def lap_rows(stage: str, data: xr.Dataset) -> list[dict[str, Any]]:
    """Return one row per lap of a stage's dataset (SI); non-finite values, and the time of a failed lap, are None."""
    names = code_names(data)
    dt = float(data["t"].values[1] - data["t"].values[0])
    driven = np.asarray(data["alive"].values).sum(axis=1) * dt
    rows = []
    for lane in range(data.sizes["lane"]):
        value = lambda name, lane=lane: np.asarray(data[name].values)[lane]
        completed = bool(value("completed"))
        row = {"stage": stage, "controller": str(value("controller")), "plant": str(value("plant")),
               "noise_seed": int(value("seed")), "code": names[int(value("code"))], "completed": completed}  # fmt: skip
        for name in ("lateral_error", "lateral_error_max", "velocity_rmse", "drift_share"):
            row[name] = float(value(name)) if np.isfinite(value(name)) else None
        rows.append(row | {"lap_time": float(driven[lane]) if completed else None})
    return rows
