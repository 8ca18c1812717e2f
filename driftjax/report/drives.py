"""Assemble the moving cars of a run: laps of `learn`, or measured runs and predictions of a diagnosis."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from driftjax.core import BadInput, from_dict
from driftjax.logs.columns import MEASURED
from driftjax.report.laps import Lap, read_laps
from driftjax.report.predictions import drawn_models
from driftjax.report.style import COMPARED, CONTROLLERS, stage_label
from driftjax.store import RunFolder
from driftjax.store.variables import OUTPUTS
from driftjax.vehicle import VehicleConfig, load_vehicle

CHANNELS = ("x", "y", "psi", "V", "beta", "r", "delta", "Fxr", "s", "e", "V_ref", "beta_ref", "r_ref", "delta_command",
            "Fxr_command")  # fmt: skip
KINDS = {"nominal": "nominal", "gpr": "gpr", "explore": "explored"}
FIRST = ("nominal", "gpr-best", "explore-best")  # stages that are shown of every plant before any other stage
LONGEST = 120.0  # of a measured run, shown from its start [s]
POINTS = 4000  # of a measured run at most


class CarDrive(NamedTuple):
    """Car in the player: a lap, a measured run, or its predictions, each from its own start."""

    group: str  # plant or run: what is shown together
    name: str
    kind: str  # nominal, gpr, explored, measured, extended or other; sets the colour
    source: str  # file and place in it
    note: str  # how it ended
    pieces: list[dict[str, np.ndarray]]  # each with t, x, y, psi and others, of equal length; SI, left positive

    def at(self, t: float) -> dict[str, float] | None:
        """Return all values at time `t` [s], of the piece that started last; None before the first and after its end.

        A lap or run, which has one piece, stands still at its end.
        """
        begun = [piece for piece in self.pieces if piece["t"][0] <= t]
        if not begun or (len(self.pieces) > 1 and t > begun[-1]["t"][-1]):
            return None
        return {name: float(np.interp(t, begun[-1]["t"], values)) for name, values in begun[-1].items()}


def shown_vehicle(run: RunFolder) -> VehicleConfig:
    """Return the nominal car of a run of `learn` or `diagnose`."""
    named = run.config["vehicle"]
    if isinstance(named, dict):
        return from_dict(VehicleConfig, named, str(run.path / "config.yaml"))
    return load_vehicle(str(named))


def lap_drives(run: RunFolder, plan: xr.Dataset) -> list[CarDrive]:
    """Return the laps of all finished stages; those to show before all others come first."""
    stages = {name: run.read_stage(name) for name in run.finished()}
    ranked: list[tuple[tuple[bool, int, int], CarDrive]] = []
    for number, (name, data) in enumerate(stages.items()):
        for controller in dict.fromkeys(data["controller"].values.tolist()):
            lanes = np.flatnonzero(data["controller"].values == controller).tolist()
            words = stage_label(name) + (f", {CONTROLLERS[controller]}" if controller == "paper" else "")
            for place, (lane, lap) in enumerate(zip(lanes, read_laps(data, controller), strict=True)):
                source = f"stages/{number:02d}_{name}.nc, lane {lane}"
                drive = CarDrive(lap_group(lap, data), words, stage_kind(name), source, *_lap(lap, data, lane, plan))
                ranked.append(((name not in FIRST, place, number), drive))
    return [drive for _, drive in sorted(ranked, key=lambda one: one[0]) if len(drive.pieces[0]["t"]) > 1]


def run_drives(run: RunFolder) -> tuple[list[CarDrive], xr.Dataset | None]:
    """Return the cars of a run of `learn` or `diagnose`, and the plan where it has one.

    Raises `BadInput` where the run holds no car to show.
    """
    if run.verb not in ("learn", "diagnose"):
        raise BadInput(
            f"{run.path}: a run of `driftjax {run.verb}` has no cars to play; take one of learn or diagnose."
        )
    plan = run.read_dataset("plan.nc") if run.verb == "learn" else None
    drives = diagnosis_drives(run.read_dataset("diagnosis.nc")) if plan is None else lap_drives(run, plan)
    if not drives:
        raise BadInput(f"{run.path}: no lap or run in it can be played; let `driftjax {run.verb}` finish.")
    return drives, plan


def shown_together(drives: Sequence[CarDrive], name: str | None) -> list[CarDrive]:
    """Return the cars of the plant or run `name`, of the first if None: laps of one kind are its best or its last.

    Raises `BadInput` that lists the names where there is no such one.
    """
    groups = list(dict.fromkeys(drive.group for drive in drives))
    wanted = groups[0] if name is None else name if name in groups else f"plant {name}"
    if wanted not in groups:
        raise BadInput(f"--show {name}: there is no such plant or run; choose one of {', '.join(groups)}.")
    kinds: dict[str, CarDrive] = {}
    for drive in drives:
        if drive.group == wanted and drive.kind != "other":
            kinds.setdefault(drive.kind, drive)
    return list(kinds.values())


def film_pairs(drives: Sequence[CarDrive]) -> list[list[CarDrive]]:
    """Return the pairs shown side by side: first and best lap, or a measured run and each prediction."""
    measured = [drive for drive in drives if drive.kind == "measured"]
    if measured:
        return [[measured[0], drive] for drive in drives if drive.kind != "measured"] or [measured]
    return [[drives[0]], [drives[-1]]] if len(drives) > 1 else [[drives[0]]]


def stage_kind(name: str) -> str:
    """Return the kind of a stage, which sets its colour."""
    return KINDS.get(name.partition("-")[0], "other")


def lap_group(lap: Lap, data: xr.Dataset) -> str:
    """Return the plant of a lap, with the noise seed where there are several."""
    return f"plant {lap.plant}" + (f", seed {lap.seed}" if len(np.unique(data["seed"].values)) > 1 else "")


def _lap(lap: Lap, data: xr.Dataset, lane: int, plan: xr.Dataset) -> tuple[str, list[dict[str, np.ndarray]]]:
    alive = data["alive"].values[lane].astype(bool)
    values = {"t": data["t"].values[alive]} | {name: lap[name] for name in CHANNELS if name in lap.values}
    if "e_ref" in lap.values:
        at = lambda name: np.interp(lap["s"], plan["path_s"].values, plan[name].values)
        values["x_ref"] = at("path_x") - lap["e_ref"] * np.sin(at("path_psi"))
        values["y_ref"] = at("path_y") + lap["e_ref"] * np.cos(at("path_psi"))
    if "gp_std" in data and np.isfinite(spread := data["gp_std"].values[lane][alive]).any():
        values |= {f"gp_std_{name}": spread[:, k] for k, name in enumerate(OUTPUTS)}
    note = "completed" if lap.completed else lap.code.lower().replace("_", " ")
    return f"{note}, mean lateral error {lap.lateral_error:.2f} m", [values]


def diagnosis_drives(data: xr.Dataset) -> list[CarDrive]:
    """Return the measured runs, and for each the predictions of every model.

    Poses are integrated from V, beta and r: from 0 for a run, from the run's own pose for a prediction.
    """
    drives = []
    for panel, group in enumerate(map(str, data["panel"].values)):
        one = data.isel(panel=panel)
        measured = _measured(one)
        if len(measured["t"]) < 2:
            continue
        thin = {name: a[:: max(len(a) // POINTS, 1)] for name, a in measured.items()}
        source = f"diagnosis.nc, panel {panel}"
        drives.append(CarDrive(group, "measured", "measured", f"{source}: measured", "", [thin]))
        for model in drawn_models(data):
            pieces = list(_predictions(one.sel(model=model), measured))
            kind, words = "extended" if model == "extended" else "nominal", f"predicted, {COMPARED[model][1]}"
            if pieces:
                drives.append(CarDrive(group, words, kind, f"{source}: predicted, {model}", "", pieces))
    return drives


def _measured(one: xr.Dataset) -> dict[str, np.ndarray]:
    """Return the measured run up to `LONGEST`; gaps in a channel are interpolated for the pose only."""
    rows, t = one["measured"].values, one["sample_time"].values
    last = np.flatnonzero(np.isfinite(rows).any(axis=1) & (t <= LONGEST))
    end = int(last[-1]) + 1 if last.size else 0
    t, rows = t[:end], rows[:end]
    values = {"t": t} | {name: rows[:, k] for k, name in enumerate(MEASURED)}
    values |= {name: one[name].values[:end] for name in ("delta", "Fxr") if name in one}
    full = [np.interp(t, t[np.isfinite(a)], a[np.isfinite(a)]) if np.isfinite(a).any() else 0 * t for a in rows.T]
    return values | integrated_pose(t, full[0], full[1], full[2])


def _predictions(one: xr.Dataset, measured: dict[str, np.ndarray]) -> Iterator[dict[str, np.ndarray]]:
    """Yield the prediction from every start, up to the end of the run."""
    for start, rows in zip(one["start_time"].values, one["predicted"].values, strict=True):
        within = np.isfinite(rows).all(axis=1)
        end = len(rows) if within.all() else int(np.argmin(within))
        if end < 2 or start > measured["t"][-1]:
            continue
        rows, t = rows[:end], start + one["ahead_time"].values[:end]
        first = [float(np.interp(t[0], measured["t"], measured[name])) for name in ("x", "y", "psi")]
        values = {"t": t} | {name: rows[:, k] for k, name in enumerate(MEASURED)}
        if "delta" in measured:
            values["delta"] = np.interp(t, measured["t"], measured["delta"])
        yield values | integrated_pose(t, rows[:, 0], rows[:, 1], rows[:, 2], *first)


def integrated_pose(
    t: np.ndarray, V: np.ndarray, beta: np.ndarray, r: np.ndarray, x: float = 0.0, y: float = 0.0, psi: float = 0.0
) -> dict[str, np.ndarray]:
    """Integrate x, y [m] and heading psi [rad] from speed, sideslip and yaw rate at `t` [s] (trapezium rule)."""
    total = lambda rate: np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(t))])
    heading = psi + total(r)
    return {"x": x + total(V * np.cos(heading + beta)), "y": y + total(V * np.sin(heading + beta)), "psi": heading}
