"""Read the laps of a stage as curves over arc length."""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from driftjax.store import RunFolder, code_names


@dataclass(frozen=True)
class Lap:
    """One lap of a stage, up to its end."""

    plant: str
    seed: int
    code: str  # how it ended
    completed: bool
    lateral_error: float  # mean over the drift section [m]
    measured_error: float  # the same by the car's own sensors: what laps are judged by [m]
    velocity_rmse: float  # over the drift section, NaN where that was not reached [m/s]
    values: dict[str, np.ndarray]  # (steps driven,), by variable

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[name]

    def over(self, s: np.ndarray, name: str) -> np.ndarray:
        """Return variable `name` at arc lengths `s` [m]; NaN beyond the end of the lap."""
        along = np.maximum.accumulate(self.values["s"]) if self.values["s"].size else np.array([np.nan])
        if self.values["s"].size < 2:
            return np.full(s.shape, np.nan)
        return np.interp(s, along, self.values[name], left=np.nan, right=np.nan)


def read_laps(data: xr.Dataset, controller: str) -> list[Lap]:
    """Return the laps of one controller in a stage, in the order of plants and seeds."""
    names, laps = code_names(data), []
    series = [str(name) for name in data.data_vars if data[name].dims == ("lane", "step")]
    for lane in np.flatnonzero(data["controller"].values == controller):
        one = data.isel(lane=int(lane))
        alive = one["alive"].values.astype(bool)
        values = {name: one[name].values[alive] for name in series}
        code = names.get(int(one["code"]), "UNKNOWN")
        measured = one.get("lateral_error_measured", one["lateral_error"])  # older runs lack it
        numbers = float(one["lateral_error"]), float(measured), float(one["velocity_rmse"])
        laps.append(Lap(str(one["plant"].values), int(one["seed"]), code, bool(one["completed"]), *numbers, values))
    return laps


def mean_curve(laps: list[Lap], s: np.ndarray, curve) -> np.ndarray:
    """Return the mean of `curve(lap, s)` over the completed laps, or over all if none is; NaN beyond their ends."""
    chosen = [lap for lap in laps if lap.completed] or laps
    rows = np.stack([curve(lap, s) for lap in chosen])
    count = np.isfinite(rows).sum(axis=0)
    return np.where(count > 0, np.nansum(rows, axis=0) / np.maximum(count, 1), np.nan)


def stages_by_kind(run: RunFolder) -> dict[str, list[str]]:
    """Return the finished stages of each kind that the paper compares: nominal, gpr, explored."""
    kinds = {"nominal": "nominal", "gpr": "gpr-", "explored": "explore-"}
    stages = {kind: [name for name in run.finished() if name.startswith(prefix)] for kind, prefix in kinds.items()}
    return {kind: names for kind, names in stages.items() if names}


def _badness(lap: Lap) -> tuple[bool, float]:
    return not lap.completed, lap.measured_error if np.isfinite(lap.measured_error) else np.inf


def best_laps(run: RunFolder, controller: str) -> dict[str, list[Lap]]:
    """Return the best lap of every plant and seed per kind of stage, chosen by what the car has measured.

    That is the lap driven with the best setting, stage gpr-best or explore-best: chosen before it was driven. Where a
    run lacks that stage, it is the completed lap with the least measured error, or else a failed one.
    """
    best: dict[str, list[Lap]] = {}
    for kind, every in stages_by_kind(run).items():
        laps = {name: [lap for lap in read_laps(run.read_stage(name), controller) if lap["s"].size] for name in every}
        driven_again = [lap for name in every if name.endswith("-best") for lap in laps[name]]
        chosen: dict[tuple[str, int], Lap] = {}
        for lap in driven_again or [lap for some in laps.values() for lap in some]:
            other = chosen.setdefault((lap.plant, lap.seed), lap)
            chosen[lap.plant, lap.seed] = min(other, lap, key=_badness)
        if chosen:
            best[kind] = list(chosen.values())
    return best


def mean_figure(laps: list[Lap], name: str) -> float:
    """Return the mean of a figure, such as `lateral_error`, over the laps that have it; NaN if none has."""
    values = np.array([getattr(lap, name) for lap in laps])
    return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else float("nan")


def drift_controllers(run: RunFolder) -> list[str]:
    """Return the drift controllers of the learning stages, in order of appearance."""
    stages = [name for names in stages_by_kind(run).values() for name in names]
    return list(dict.fromkeys(name for stage in stages for name in run.read_stage(stage)["controller"].values.tolist()))


def controlled_span(laps: list[Lap]) -> tuple[float, float] | None:
    """Return the median arc lengths at which the drift controller took over and handed back [m]."""
    spans = [(lap["s"][d].min(), lap["s"][d].max()) for lap in laps if (d := lap["drifting"].astype(bool)).any()]
    return (float(np.median([a for a, _ in spans])), float(np.median([b for _, b in spans]))) if spans else None
