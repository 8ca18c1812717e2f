"""Bin residual forces over explanatory variables: means, variance explained beyond chance, the largest in words."""

from typing import NamedTuple

import numpy as np

from driftjax.diagnosis.residual import FORCES, ResidualForces, force_limits
from driftjax.diagnosis.select import LEVEL
from driftjax.vehicle import VehicleConfig

BINS = 10  # of equal numbers of samples
MIN_BLOCKS = 3  # blocks of time below which a bin says nothing
DRAWS = 499  # of random signs
DESCRIPTIONS = {
    "Fx": "the longitudinal force", "Fyf": "the lateral force of the front axle",
    "Fyr": "the lateral force of the rear axle", "slip_front": "the front slip angle",
    "slip_rear": "the rear slip angle", "drive": "the drive force", "speed": "the speed",
    "time": "the time since the run's start", "heading": "the heading", "position": "the position along the lap",
}  # fmt: skip


class Binned(NamedTuple):
    """Residual forces binned over one variable (B bins, ascending; bins with too few blocks omitted)."""

    value: np.ndarray  # (B,) mean of the driver
    mean: np.ndarray  # (B, 3) [N]
    error: np.ndarray  # (B, 3) standard error, robust to dependence within blocks [N]
    explained: np.ndarray  # (3,) share of the force's variance that the bins explain, less what chance gives
    systematic: np.ndarray  # (3,) RMS of the force as a function of the driver, less what chance gives [N]
    ratio: np.ndarray  # (3,) sum of squares of the bins' means over what chance gives
    null_ratio: np.ndarray  # (DRAWS, 3) the same under random signs of the blocks


class ForceSummary(NamedTuple):
    """Summary of one model's residual forces over all explanatory variables."""

    rms: np.ndarray  # (3,) [N]; NaN, as are all values of it, for a force that was estimated
    variables: dict[str, Binned]
    p_value: float  # that chance gives the largest ratio


def bin_forces(values: np.ndarray, forces: np.ndarray, block: np.ndarray, signs: np.ndarray) -> Binned | None:
    """Bin `forces` (n, 3) over the variable `values` (n,); None where it is nearly constant.

    The mean of a bin is taken as that of independent blocks: its error sums the squares of the blocks' sums.
    """
    edges = np.unique(np.quantile(values, np.linspace(0, 1, BINS + 1)))
    if len(edges) < 3:
        return None
    which = np.searchsorted(edges[1:-1], values, side="right")
    sums, counts = np.zeros((signs.shape[1], len(edges) - 1, 3)), np.zeros((signs.shape[1], len(edges) - 1))
    np.add.at(sums, (block, which), forces)
    np.add.at(counts, (block, which), 1.0)
    blocks = (counts > 0).sum(axis=0)
    use = blocks >= MIN_BLOCKS
    if use.sum() < 2:
        return None
    sums, counts, blocks = sums[:, use], counts[:, use], blocks[use, None]
    n = counts.sum(axis=0)[:, None]
    mean = sums.sum(axis=0) / n
    off = ((sums - counts[..., None] * mean) ** 2).sum(axis=0) * blocks / (blocks - 1)  # few clusters
    kept = use[which]
    value = np.array([values[which == j].mean() for j in np.flatnonzero(use)])
    chance, square = (off / n).sum(axis=0), (n * mean**2).sum(axis=0)
    overall = forces[kept].mean(axis=0)
    between = (n * (mean - overall) ** 2).sum(axis=0)
    total = ((forces[kept] - overall) ** 2).sum(axis=0)
    drawn = ((np.einsum("dc,cbf->dbf", signs, sums) ** 2) / n).sum(axis=1)
    return Binned(
        value, mean, np.sqrt(off) / n, np.maximum(between - chance, 0.0) / total,
        np.sqrt(np.maximum(square - chance, 0.0) / kept.sum()), square / chance, drawn / chance,
    )  # fmt: skip


def summarise_forces(residual: ResidualForces, seed: int) -> ForceSummary:
    """Return residual forces binned over every variable, with a test that they depend on none of them."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (DRAWS, residual.block.max() + 1))
    each = {
        name: bin_forces(values, residual.forces, residual.block, signs) for name, values in residual.variables.items()
    }
    over = {name: one for name, one in each.items() if one is not None}
    rms = np.sqrt((residual.forces**2).mean(axis=0))
    if not over:
        return ForceSummary(rms, over, 1.0)
    largest = np.max([np.nanmax(one.null_ratio, axis=1) for one in over.values()], axis=0)
    most = max(float(np.nanmax(one.ratio)) for one in over.values())
    return ForceSummary(rms, over, float((1 + np.sum(largest >= most)) / (DRAWS + 1)))


def best_variable(summary: ForceSummary, force: int) -> str | None:
    """Return the variable that explains most of a force; None where chance would explain as much."""
    if not summary.variables:
        return None
    name = max(summary.variables, key=lambda one: summary.variables[one].explained[force])
    return name if summary.variables[name].explained[force] > 0 else None


def describe_worst(summary: ForceSummary, vehicle: VehicleConfig) -> str:
    """Describe the largest residual force in one sentence: its size and the variable that explains most of it."""
    size = force_limits(vehicle)
    systematic = (
        np.max([one.systematic for one in summary.variables.values()], axis=0) if summary.variables else summary.rms
    )
    clear = summary.p_value < LEVEL
    force = int(np.nanargmax((systematic if clear else summary.rms) / size))
    amount = f"{float(f'{summary.rms[force]:.3g}'):g} N RMS ({100 * summary.rms[force] / size[force]:.2g} % of mu Fz)"
    if not clear:
        text = f"No residual force goes with anything looked at (p = {summary.p_value:.2f}); the largest is "
        return text + f"{DESCRIPTIONS[FORCES[force]]}, {amount}."
    name = DESCRIPTIONS[FORCES[force]]
    text = f"{name[0].upper()}{name[1:]} is off most: {amount}"
    by = best_variable(summary, force)
    if by is None:
        return text + ", wherever and however the car drives."
    share = f"{100 * summary.variables[by].explained[force]:.0f} % of its variance (p = {summary.p_value:.3f})"
    return text + f"; it goes with {DESCRIPTIONS[by]} most, which explains {share}."
