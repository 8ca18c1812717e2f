"""Measure how much of a lap evaluates the Gaussian process far from its data."""

import numpy as np

from driftjax.gp.model import FADE_LENGTH, fade_factor
from driftjax.store import RunFolder
from driftjax.studies.paper.laps import driven_steps

FADED = 0.5  # fade factor below which an input counts as far from data
STAGES = ("single-layer", "gpr-1", "gpr-best", "explore-best")


def extrapolated(run: RunFolder, controller: str, section: tuple[float, float]) -> dict[str, float]:
    """Return the share of the driven drift section where the mean is faded to less than half, by stage."""
    shares = {}
    for name in STAGES:
        if name not in run.finished():
            continue
        data, lap_values = run.read_stage(name), []
        for entry in np.flatnonzero(data["controller"].values == controller):
            lap = data.isel(lane=int(entry))
            inside = driven_steps(lap, section)
            z = np.stack([lap[key].values[inside] for key in ("V", "beta", "r", "delta", "Fxr")], axis=1)
            lap_values.append(_faded(z, lap["gp_Z"].values[lap["gp_mask"].values.astype(bool)]))
        every = np.concatenate(lap_values) if lap_values else np.zeros(0)
        shares[name] = float(np.mean(every)) if len(every) else float("nan")
    return shares


def _faded(z: np.ndarray, Z: np.ndarray) -> np.ndarray:
    """Return whether the mean at `z` (n, 5) from data at `Z` (m, 5) is faded; always so without data."""
    if len(Z) < 2:
        return np.ones(len(z), bool)
    offset = (z[:, None] - Z[None]) / (FADE_LENGTH * np.std(Z, axis=0))
    near = np.sum(np.exp(-0.5 * np.sum(offset**2, axis=-1)), axis=1)
    return np.asarray(fade_factor(near)) < FADED
