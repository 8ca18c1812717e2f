"""Residual forces: forces of each axle beyond the model, and the variables they depend on.

A disturbance of the rates is a longitudinal force, a lateral force and a moment, which are equivalent to a drive force
and a lateral force on each axle. A cause at one axle therefore appears at that axle only.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from driftjax.core import Control, State
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.noise import estimate_noise
from driftjax.diagnosis.noise_model import Noise
from driftjax.diagnosis.observer import Path, Steps, samples_in_run
from driftjax.diagnosis.runs import error_blocks, lap_lengths, run_observer, step_derivatives
from driftjax.diagnosis.smooth import smooth_disturbances
from driftjax.logs import Run
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect.flow import CarParameters
from driftjax.vehicle.single_track import G

FORCES = ("Fx", "Fyf", "Fyr")
SKIPPED_START = 0.5  # time after a run's start that is left out: commands before it are not known [s]


class ResidualForces(NamedTuple):
    """Residual forces of one model at n samples, with explanatory variables."""

    forces: np.ndarray  # (n, 3) drive force, lateral force of front and of rear axle [N], left positive
    variables: dict[str, np.ndarray]  # (n,) each, SI
    block: np.ndarray  # (n,) number of the block of time


def disturbance_forces(
    vehicle: VehicleConfig | CarParameters, x: np.ndarray, delta: np.ndarray, push: np.ndarray
) -> np.ndarray:
    """Return the axle forces (..., 3) [N] that cause the additional rates `push` (..., 3) in the state `x` (..., 3).

    dX = m (dV' cos beta - V dbeta' sin beta), dY = m (dV' sin beta + V dbeta' cos beta), dN = Iz dr'; and
    dY = dFyf cos delta + dFyr, dN = a dFyf cos delta - b dFyr, dX = dFx - dFyf sin delta.
    """
    (V, beta, _), (dV, dbeta, dr) = np.moveaxis(x, -1, 0), np.moveaxis(push, -1, 0)
    X = vehicle.m * (dV * np.cos(beta) - V * dbeta * np.sin(beta))
    Y = vehicle.m * (dV * np.sin(beta) + V * dbeta * np.cos(beta))
    N = vehicle.Iz * dr
    L = vehicle.a + vehicle.b
    Fyf = (vehicle.b * Y + N) / (L * np.cos(delta))
    Fyr = (vehicle.a * Y - N) / L
    return np.stack([X + Fyf * np.sin(delta), Fyf, Fyr], axis=-1)


def force_limits(vehicle: VehicleConfig) -> np.ndarray:
    """Return the reference sizes (3,) of residual forces: friction times static load, of the rear axle for Fx [N]."""
    front, rear = (vehicle.mu * vehicle.m * G * arm / (vehicle.a + vehicle.b) for arm in (vehicle.b, vehicle.a))
    return np.array([rear, front, rear])


def observer_path(problem: Problem, theta: np.ndarray) -> tuple[Path, Steps]:
    """Return the observer's path under `theta`, and the derivatives of its steps."""
    path = run_observer(problem.model, problem.data, theta, problem.gains)
    return path, step_derivatives(problem.model, problem.data, theta, path, problem.active)


def nominal_noise(problem: Problem, path: Path, steps: Steps) -> Noise:
    """Estimate the noise that the nominal car needs on `path` when no effect explains its errors.

    The slow errors of the sensors are the same for every car: they must not absorb errors of the nominal one.
    """
    one = lambda derivatives: jnp.zeros_like(derivatives[..., :1])  # a column for no parameter: a smaller program
    bare = steps._replace(C=one(steps.C), F=one(steps.F), first=one(steps.first))
    data = problem.data
    return estimate_noise(bare, path.e, problem.gains, problem.noise, data.dt, data.informative, slow_known=True)


def residual_forces(
    vehicle: VehicleConfig, problem: Problem, path: Path, steps: Steps, noise: Noise, runs: Sequence[Run]
) -> ResidualForces:
    """Return the residual forces on `runs`, those of `problem`, of the model that gave `path`.

    A drive force that was estimated is the one that explains the speed: nothing is known of what is beyond it (NaN).
    The disturbance of the speed is an error of that force then, and no rate that axles cause.
    """
    valid = np.asarray(path.valid)
    known = problem.data.force_known
    x, push = smooth_disturbances(path, steps, valid, noise, problem.data.dt, speed_known=not known)
    u = np.asarray(path.u)
    forces = disturbance_forces(vehicle, x, u[..., 0], push if known else push * [0, 1, 1])
    forces[..., 0] = forces[..., 0] if known else np.nan
    keep = samples_in_run(valid) & (np.arange(valid.shape[1]) >= round(SKIPPED_START / problem.data.dt))
    over = variables(vehicle, problem, x, u, runs)
    return ResidualForces(
        forces[keep], {name: values[keep] for name, values in over.items()}, error_blocks(problem.data)[keep]
    )


def variables(
    vehicle: VehicleConfig, problem: Problem, x: np.ndarray, u: np.ndarray, runs: Sequence[Run]
) -> dict[str, np.ndarray]:
    """Return the explanatory variables (P, T); heading and position only where every run measured them."""
    nominal, place = vehicle.build(), problem.data.padded.place
    front, rear = nominal.slip_angles(State(*np.moveaxis(x, -1, 0)), Control(*np.moveaxis(u[..., :2], -1, 0)))
    values = {
        "slip_front": np.asarray(front), "slip_rear": np.asarray(rear), "drive": u[..., 1], "speed": x[..., 0],
        "time": np.asarray(place.t),
    }  # fmt: skip
    if all("psi" in run.extra for run in runs):
        values["heading"] = np.angle(np.exp(1j * np.asarray(place.psi)))
    if all("s" in run.extra for run in runs):
        values["position"] = np.array(lap_lengths(tuple(runs)))[problem.data.run, None] * np.asarray(place.s)
    return values
