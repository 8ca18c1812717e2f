"""Data of the player in a page: cars, road and traces, packed."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from driftjax.report.drives import CarDrive
from driftjax.report.html import pack
from driftjax.report.shape import body, wheels
from driftjax.vehicle import VehicleConfig

ROOM = 1_800_000  # characters of packed numbers in a page at most: further cars are left out, and the page says so
BEFORE, AFTER = 15.0, 12.0  # around the planned drift, in the view of the corner [m]


def player_data(vehicle: VehicleConfig, drives: Sequence[CarDrive], plan: xr.Dataset | None = None) -> dict[str, Any]:
    """Return the data of the player: the first of `drives`, up to its size limit."""
    shown, size = [], 0
    for drive in drives:
        size += sum(len(a) for piece in drive.pieces for a in piece.values()) * 8 // 3  # 2 bytes each, as base64
        if size > ROOM and shown:
            break
        pieces = [{name: pack(a) for name, a in piece.items()} for piece in drive.pieces]
        shown.append(drive._asdict() | {"pieces": pieces})
    shape = wheels(vehicle) | {"body": body(vehicle), "name": vehicle.name}
    left_out = len(drives) - len(shown)
    return {"car": shape, "drives": shown, "left_out": left_out, "road": None if plan is None else _road(plan)}


def _road(plan: xr.Dataset) -> dict[str, Any]:
    """Return borders and planned path, thinned, and where the planned drift begins and ends."""
    thin = lambda name, most=1500: pack(plan[name].values[:: max(plan[name].size // most, 1)])
    lines = {side: {"x": thin(f"{side}_x"), "y": thin(f"{side}_y")} for side in ("left", "right", "path")}
    start, end = float(plan.attrs["drift_start"]), float(plan.attrs["drift_end"])
    near = (plan["path_s"].values > start - BEFORE) & (plan["path_s"].values < end + AFTER)
    corner = [[float(f(plan[name].values[near])) for f in (np.min, np.max)] for name in ("path_x", "path_y")]
    closed = bool(plan.attrs.get("closed", False))
    return lines | {"closed": closed, "corner": corner, "s": [start - BEFORE, end + AFTER], "drift": [start, end]}
