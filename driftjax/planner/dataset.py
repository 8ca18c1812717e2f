"""Convert a minimum-time plan to a dataset, and to a CSV table."""

from pathlib import Path

import jax
import numpy as np
import xarray as xr

from driftjax.core import write_atomically
from driftjax.planner.planner import Plan
from driftjax.store.variables import PLAN, dataset
from driftjax.track import Track

NODES = ("s", "t", "V", "beta", "r", "e", "theta", "delta", "Fxr", "x", "y", "psi", "S", "drift")


def plan_dataset(plan: Plan, track: Track, car: str) -> xr.Dataset:
    """Build plan.nc from a plan along a track of the car named `car`."""
    left, right = (jax.vmap(track.position)(track.s, side) for side in (track.w_left, -track.w_right))
    values = {name: getattr(plan, name) for name in NODES}
    values |= {"track_x": track.x, "track_y": track.y}
    values |= {"left_x": left[0], "left_y": left[1], "right_x": right[0], "right_y": right[1]}
    values |= {f"path_{name}": getattr(plan.path, name) for name in ("s", "x", "y", "psi", "kappa")}
    intervals = plan.drift_intervals()
    start, end = plan.drift_interval() if intervals else (np.nan, np.nan)
    attrs = {
        "car": car, "closed": int(track.closed), "lap_time": float(plan.lap_time), "drift_start": start,
        "drift_end": end, "kkt": float(plan.kkt), "violation": float(plan.violation),
        "num_steps": int(plan.num_steps),
    }  # fmt: skip
    return dataset(values, attrs, PLAN)


def write_plan_csv(path: Path, data: xr.Dataset) -> None:
    """Write the nodes of plan.nc as CSV: one row per node, a header with name and unit."""
    names = [name for name in NODES if name in data]
    columns = np.stack([np.asarray(data[name], float) for name in names], axis=1)
    header = ",".join(f"{name} [{PLAN[name].units}]" for name in names)
    write_atomically(path, lambda p: np.savetxt(p, columns, "%.9g", ",", header=header, comments=""))
