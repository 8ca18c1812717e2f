"""Find the stretches of a log that decide different parameters: coasting, straight, cornering with grip, the limit.

They follow from what the nominal car's observer predicts for a sample from those before it, and from the commands.
Which samples count is thus known before they are measured, and their innovations make a partial likelihood (Cox 1975).
"""

from enum import IntEnum

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from driftjax.core import Control, State
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.observer import samples_in_run
from driftjax.diagnosis.residual import disturbance_forces
from driftjax.diagnosis.runs import run_observer
from driftjax.vehicle.effect.flow import CarParameters
from driftjax.vehicle.single_track import G

COAST_BELOW = 0.02  # longitudinal force over weight
STRAIGHT_BELOW = 0.1  # lateral force of an axle over friction times load
LIMIT_FROM = 0.6  # force of an axle over friction times load, or lateral force of its nominal tyre at its slip angle
SMOOTH, HOLD = 0.25, 1.0  # time over which forces are averaged, and for which the hardest of them counts [sqrt(L/g)]
NOWHERE = -1  # samples that do not count


class Stretch(IntEnum):
    """Kinds of stretches, each harder on the tyres than those before."""

    COASTING = 0
    STRAIGHT = 1
    CORNERING = 2
    LIMIT = 3

    @property
    def label(self) -> str:
        """Return the name as printed."""
        return self.name.lower()


def find_stretches(problem: Problem) -> np.ndarray:
    """Return the kind of stretch of each sample (P, T); `NOWHERE` for those that do not count.

    A sample belongs to the hardest kind of the time `HOLD` before it, so that the tyres and the observer have settled.
    """
    data, model = problem.data, problem.model.with_parameters(jnp.asarray(problem.start))
    car, shares = model.car, [float(model.values().get(name, (0.0,))[0]) for name in ("drive_split", "brake_split")]
    path = run_observer(problem.model, data, problem.start, problem.gains)
    steps = lambda span: max(round(span * float(car.unit_time) / data.dt), 1)
    causal = lambda filtered, f, n: filtered(f, n, axis=1, mode="nearest", origin=(n - 1) // 2)
    smooth = lambda f: causal(uniform_filter1d, np.asarray(f), steps(SMOOTH))
    lateral, slip, Fx = grip_use(car, np.asarray(path.predicted), np.asarray(path.rates)[:, :, 0], np.asarray(path.u))
    lateral, slip, Fx = smooth(lateral), smooth(slip), smooth(Fx)
    front = np.where(Fx > 0, *shares)
    along = np.stack([front * Fx, (1 - front) * Fx], axis=2) / largest_forces(car)
    used = np.maximum(np.hypot(lateral, along), tyre_use(car, slip)).max(axis=2)
    kind = np.where(np.abs(Fx) < COAST_BELOW * float(car.m) * G, Stretch.COASTING, Stretch.STRAIGHT)
    kind = np.where(np.abs(lateral).max(axis=2) < STRAIGHT_BELOW, kind, Stretch.CORNERING)
    kind = np.where(used < LIMIT_FROM, kind, Stretch.LIMIT)
    kind = causal(maximum_filter1d, kind, steps(HOLD))
    within = samples_in_run(np.asarray(data.padded.valid)) & data.informative.any(axis=1)
    return np.where(within, kind, NOWHERE)


def grip_use(
    car: CarParameters, z: np.ndarray, rates: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return lateral forces over friction times load (P, T, 2), slip angles (P, T, 2) [rad] and drive force (P, T) [N].

    By Newton's law from augmented states `z` (P, T, 6), `rates` (P, T, 3) and inputs `u` (P, T, 4); front, rear.
    """
    x, turning = z[..., :3], z[..., 2:3] * np.array([0.0, 1.0, 0.0])  # the velocity turns at beta' + r
    forces = disturbance_forces(car, x, np.zeros_like(x[..., 0]), rates + turning)  # along and across the body
    slip = car.nominal.slip_angles(State(*np.moveaxis(x, -1, 0)), Control(*np.moveaxis(u[..., :2], -1, 0)))
    return forces[..., 1:] / largest_forces(car), np.stack(slip, axis=2), u[..., 1]


def largest_forces(car: CarParameters) -> np.ndarray:
    """Return friction times static load of front and rear axle [N]."""
    return np.array([float(car.muf * car.nominal.Fzf), float(car.mur * car.nominal.Fzr)])


def tyre_use(car: CarParameters, slip: np.ndarray) -> np.ndarray:
    """Return the share of friction that the nominal tyres use at slip angles (P, T, 2), 1 from the peak on."""
    B, C = (np.array([float(value) for value in pair]) for pair in ((car.Bf, car.Br), (car.Cf, car.Cr)))
    return np.sin(np.minimum(C * np.arctan(B * np.abs(slip)), np.pi / 2))


def durations(stretch: np.ndarray, dt: float) -> dict[str, float]:
    """Return the time [s] that samples of each kind `stretch` (P, T) make."""
    return {kind.label: float(np.sum(stretch == kind) * dt) for kind in Stretch}
