"""Check kinematic parity: whether measured accelerations and motion agree, independent of the car model.

dV/dt = ax cos beta + ay sin beta and dbeta/dt = (ay cos beta - ax sin beta) / V - r hold without any parameter of the
car (Ryu and Gerdes 2004). Where they fail, a sensor or the road is at fault, not the model of the car. Nothing is
differentiated: the change over a window is compared with the integral of the right-hand side.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, stdtrit

from driftjax.diagnosis.noise import measurement_noise
from driftjax.diagnosis.runs import ERROR_BLOCK
from driftjax.logs import Run
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.single_track import G

WINDOW = 0.3  # over which changes are compared [s]
MIN_SPEED = 0.1  # speed, over sqrt(g L), below which the sideslip's rate says nothing [-]
CHANCE = 1e-4  # false-alarm probability per channel and test
MARGIN = 1.1  # RMS of blocks over what noise gives, from how well the noise is known
CHANNELS = ("V", "beta")
UNITS = ("m/s^2", "rad/s")


class Windows(NamedTuple):
    """Measured minus integrated motion, as mean rates over n windows without missing samples."""

    residual: np.ndarray  # (n, 2) of V [m/s^2] and beta [rad/s]
    ends: np.ndarray  # (n, 2) variance from the noise of the first and the last sample, the same for all
    within: np.ndarray  # (n, 2) variance from the noise of all samples on the right-hand side
    block: np.ndarray  # (n,) number of the block of time
    opens: np.ndarray  # (n,) whether no window of its block ends where it begins


class Parity(NamedTuple):
    """Agreement of motion and accelerations, per channel V [m/s^2], beta [rad/s]."""

    mean: np.ndarray  # (2,)
    z: np.ndarray  # (2,) the mean over its standard error, robust to dependence within blocks
    rms: np.ndarray  # (2,) of windows
    floor: np.ndarray  # (2,) RMS that the measurement noise alone gives
    excess: np.ndarray  # (2,) RMS of blocks of time over what noise gives: 1 where all agrees, slow errors show most
    num: int  # windows
    statement: str


def parity(vehicle: VehicleConfig, runs: Sequence[Run], sigma: np.ndarray) -> Parity | None:
    """Test the parity of all `runs` for the measurement noise `sigma` (3,) of V, beta, r.

    None where a run lacks ax or ay, or too little was measured in a row to compare anything.
    """
    if not all({"ax", "ay"} <= set(run.extra) for run in runs):
        return None
    slowest = MIN_SPEED * np.sqrt(G * (vehicle.a + vehicle.b))
    noise = acceleration_noise(runs)
    parts = [windows(run, np.asarray(sigma), noise, slowest) for run in runs]
    shift = np.cumsum([0, *(part.block.max(initial=-1) + 1 for part in parts)])
    numbered = [part._replace(block=part.block + at) for part, at in zip(parts, shift[:-1], strict=True)]
    return summary(Windows(*(np.concatenate(column) for column in zip(*numbered, strict=True))))


def summary(all_of: Windows) -> Parity | None:
    """Return mean, errors and statement; None for fewer than three blocks."""
    rest, ends, within, block, opens = all_of
    names, block = np.unique(block, return_inverse=True)
    if (C := len(names)) < 3:
        return None
    total = lambda values: np.stack([np.bincount(block, column) for column in values.T], axis=1)
    mean, n = rest.mean(axis=0), len(rest)
    error = np.sqrt((total(rest - mean) ** 2).sum(axis=0) * C / (C - 1)) / n
    # windows that follow each other share their ends: of a sum only the noise at both ends of each stretch is left
    excess = np.sqrt((total(rest) ** 2 / (total(ends * opens[:, None]) + total(within))).mean(axis=0))
    rms, floor = np.sqrt((rest**2).mean(axis=0)), np.sqrt((ends + within).mean(axis=0))
    z = mean / np.maximum(error, floor / n)
    return Parity(mean, z, rms, floor, excess, n, statement(mean, z, excess, C))


def acceleration_noise(runs: Sequence[Run]) -> np.ndarray:
    """Return the standard deviation (2,) of the measured ax, ay [m/s^2], the median over runs."""
    each = []
    for run in runs:
        a = np.stack([run.extra["ax"], run.extra["ay"]], axis=1)[None]
        valid = np.isfinite(a)
        each.append(measurement_noise(np.where(valid, a, 0.0), valid))
    return np.median(each, axis=0)


def windows(run: Run, sigma: np.ndarray, noise: np.ndarray, slowest: float) -> Windows:
    """Return consecutive windows of one run; those with a gap or below the speed `slowest` are omitted."""
    W, (ax, ay) = max(round(WINDOW / run.dt), 2), (run.extra["ax"], run.extra["ay"])
    cos, sin, V = np.cos(run.beta), np.sin(run.beta), np.maximum(run.V, slowest)
    across = ay * cos - ax * sin
    rates = np.stack([ax * cos + ay * sin, across / V - run.r], axis=1)
    y = np.stack([run.V, run.beta], axis=1)
    starts = np.arange(0, len(run.t) - W, W)
    rows = starts[:, None] + np.arange(W + 1)
    whole = np.isfinite(rates[rows]).all(axis=(1, 2)) & np.isfinite(y[rows]).all(axis=(1, 2))
    whole &= (run.V[rows] > slowest).all(axis=1)
    starts, rows = starts[whole], rows[whole]
    T = W * run.dt
    weight = np.r_[0.5, np.ones(W - 1), 0.5] / W  # the trapezium rule, as a mean
    rest = (y[starts + W] - y[starts]) / T - np.einsum("w,nwc->nc", weight, rates[rows])
    # what one sample's noise does to the right-hand side: ax, ay, beta and, for the sideslip, V and r
    a, speed, side = np.mean(noise**2), V[rows].mean(axis=1), (across[rows] ** 2).mean(axis=1)
    of_V = a + side * sigma[1] ** 2
    along = (rates[rows][..., 0] ** 2).mean(axis=1)
    of_beta = (a + along * sigma[1] ** 2 + side * (sigma[0] / speed) ** 2) / speed**2 + sigma[2] ** 2
    ends = np.broadcast_to(2 * sigma[:2] ** 2 / T**2, rest.shape)
    within = np.stack([of_V, of_beta], axis=1) * (weight**2).sum()
    block = (starts * run.dt // ERROR_BLOCK).astype(int)
    opens = (np.diff(starts, prepend=-2 * W) > W) | (np.diff(block, prepend=-1) > 0)
    return Windows(rest, ends, within, block, opens)


def statement(mean: np.ndarray, z: np.ndarray, excess: np.ndarray, num: int) -> str:
    """Describe the location of the fault that parity over `num` blocks indicates."""
    clear, parts = -stdtrit(num - 1, CHANCE / 2), []
    most = MARGIN * np.sqrt(chdtri(num, CHANCE) / num)
    for name, unit, m, one, ratio in zip(("V'", "beta'"), UNITS, mean, z, excess, strict=True):
        if abs(one) > clear:
            parts.append(f"{name} is off by {m:.2g} {unit} on average (z = {one:.1f})")
        elif ratio > most:
            parts.append(f"{name} errs by {ratio:.1f} times what noise gives")
    if parts:
        text = "The accelerations and the motion disagree, which no car can cause: "
        return text + ", ".join(parts) + "; a sensor or the road is at fault."
    return "The accelerations and the motion agree within noise: if anything is wrong, it is in the forces on the car."
