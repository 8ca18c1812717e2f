"""Turn a recording into a log: noisy positions, outliers and dropouts."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from driftjax.logs import Run
from driftjax.sim.record import Recording

LOST = 5  # mean length of a dropout [samples]
OUTLIER = (10.0, 30.0)  # size of outliers, relative to the typical noise


class Flaws(NamedTuple):
    """Imperfections of a log besides the noise of V, beta, r."""

    dropouts: float  # share of samples in which V, beta and r are missing
    outliers: float  # share of their values that are outliers
    typical: Float[np.ndarray, "3"]  # noise of V, beta, r that scales the outliers
    metres: float  # standard deviation of x, y, s [m]
    heading: float  # standard deviation of psi [rad]
    acceleration: float  # standard deviation of ax, ay [m/s^2]


def logged(name: str, recording: Recording, lap: float, dt: float, flaws: Flaws, rng: np.random.Generator) -> Run:
    """Return a recorded run as a log sampled every `dt` [s]; s restarts at every lap of length `lap` [m]."""
    y, num = np.array(recording.y), len(recording.y)
    off = rng.uniform(*OUTLIER, y.shape) * rng.choice([-1.0, 1.0], y.shape) * flaws.typical
    y += np.where(rng.uniform(size=y.shape) < flaws.outliers, off, 0.0)
    V, beta, r = np.where(dropouts(rng, num, flaws.dropouts)[:, None], np.nan, y).T
    V = np.maximum(V, 0.0)  # a speed is never negative
    delta, Fxr = np.array(recording.command).T
    x, y, s = np.stack([*recording.position.T, lap * recording.place.s]) + flaws.metres * rng.standard_normal((3, num))
    psi = np.asarray(recording.place.psi) + flaws.heading * rng.standard_normal(num)
    ax, ay = np.array(recording.a).T + flaws.acceleration * rng.standard_normal((2, num))
    extra = {"x": x, "y": y, "psi": psi, "s": np.clip(s, 0.0, lap), "ax": ax, "ay": ay}
    return Run(name, np.arange(num) * dt, V, beta, r, delta, Fxr, dt, extra)


def dropouts(rng: np.random.Generator, num: int, share: float) -> np.ndarray:
    """Mark which of `num` samples are lost: a fraction `share`, in gaps of mean length `LOST`; never the first."""
    u, lost = rng.uniform(size=num), np.zeros(num, bool)
    for i in range(1, num):
        lost[i] = u[i] < (1 - 1 / LOST if lost[i - 1] else share / (1 - share) / LOST)
    return lost
