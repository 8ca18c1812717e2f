"""Logs of a simulator that is not ours: the CommonRoad vehicle models (Althoff and Wuersching 2020), a BMW 320i.

The drift model (std) is a single track with wheel spin, a full Magic Formula and longitudinal load transfer; the
multi-body model (mb) adds suspension, roll, pitch, camber and compliance. Neither shares code with driftjax. The
nominal car has their mass, inertia, geometry and tyre, a friction circle, and no load transfer.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from driftjax.core import BadInput, rk4_step
from driftjax.logs import Run
from driftjax.manoeuvres.campaign import SPIN
from driftjax.manoeuvres.library import multisine
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.single_track import G

RUNS, ROWS, DT, STEP = 6, 1000, 0.01, 1e-3  # 60 s at 100 Hz, solved at 1 kHz
STEER_RATE = 0.4  # largest [rad/s], theirs
LATERAL, DRIVE = 5.5, 3.0  # largest commanded acceleration [m/s^2]
SPEEDS = (10.0, 15.0)  # at the start of a run [m/s]; driving raises them to some 27
SIGMA = (0.05, np.deg2rad(0.5), np.deg2rad(0.5), np.deg2rad(0.2))  # noise of V [m/s], beta, r, psi
REDRAWS = 20


@functools.cache
def simulator(car: str) -> tuple[Callable, Callable, Any]:
    """Return right-hand side f(x, u, p), initial state x(core state, p) and parameters p of the simulator `car`."""
    try:
        from vehiclemodels import init_mb, init_std, parameters_vehicle2, vehicle_dynamics_mb, vehicle_dynamics_std
    except ImportError as error:
        raise BadInput(f"foreign cases need the package commonroad-vehicle-models ({error}); install it.") from None
    p = parameters_vehicle2.parameters_vehicle2()
    if car == "std":
        return vehicle_dynamics_std.vehicle_dynamics_std, init_std.init_std, p
    return vehicle_dynamics_mb.vehicle_dynamics_mb, init_mb.init_mb, p


def foreign_vehicle() -> VehicleConfig:
    """Return the nominal car with their parameters: cornering stiffness, friction and C of their tyre."""
    p = simulator("std")[2]
    mu, C = p.tire.p_dy1, p.tire.p_cy1
    weight = p.m * G
    return VehicleConfig(
        "bmw", p.m, p.I_z, p.a, p.b, mu, -p.tire.p_ky1 / (C * mu), C, p.w, p.l, delta_max=0.9,
        delta_rate_max=STEER_RATE, Fxr_min=-0.3 * weight, Fxr_max=0.6 * weight, Fxr_rate_max=10 * weight,
        combined_slip=1.0,
    )  # fmt: skip


def height(car: str) -> float:
    """Return the height of the centre of mass in their load transfer [m]."""
    p = simulator(car)[2]
    return p.h_s if car == "std" else p.h_cg


def foreign_runs(car: str, seed: int, noise: float, num: int = RUNS) -> tuple[Run, ...]:
    """Simulate `num` runs of cornering with changing drive, measured with `noise` times the typical noise."""
    rng = np.random.default_rng(seed)
    return tuple(_run(f"{car}-{i + 1}", car, rng, noise) for i in range(num))


def _run(name: str, car: str, rng: np.random.Generator, noise: float) -> Run:
    """Simulate one run; it is drawn again if the car spins."""
    t = np.arange(ROWS) * DT
    for _ in range(REDRAWS):
        lateral = LATERAL * _unit_wave(rng, t, 0.15, 0.8)
        drive = np.maximum(DRIVE * (0.45 + 0.55 * _unit_wave(rng, t, 0.1, 0.6)), 0.0)  # brakes would act on all wheels
        x, steered, weight = follow_commands(car, rng.uniform(*SPEEDS), lateral, drive)
        if np.isfinite(x).all() and np.abs(x[:, 1]).max() < SPIN:
            V, beta, r, psi = (x + noise * np.array(SIGMA) * rng.standard_normal(x.shape)).T
            return Run(name, t, V, beta, r, steered, weight * drive, DT, {"psi": psi})
    raise RuntimeError(f"the {car} car spun in {REDRAWS} draws of {name}")


def _unit_wave(rng: np.random.Generator, t: np.ndarray, slow: float, fast: float) -> np.ndarray:
    """Return a multisine between -1 and 1."""
    wave = multisine(rng, t, slow, fast)
    return wave / np.abs(wave).max()


def follow_commands(
    car: str, speed: float, lateral: np.ndarray, drive: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return V, beta, r, psi (T, 4), the mean steering angle over each sample (T,), and the mass [kg].

    The steering angle is that of a neutral car at the `lateral` acceleration [m/s^2]; `drive` is the engine's [m/s^2].
    """
    f, start, p = simulator(car)
    x, rows, steered = np.array(start([0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0], p), float), [], []
    for wanted, push in zip(lateral, drive, strict=True):
        V = x[3] if car == "std" else float(np.hypot(x[3], x[10]))
        beta = x[6] if car == "std" else float(np.arctan2(x[10], x[3]))
        rows.append((V, beta, x[5], x[4]))
        rate = np.clip((wanted * (p.a + p.b) / V**2 - x[2]) / DT, -STEER_RATE, STEER_RATE)
        before = x[2]
        for _ in range(round(DT / STEP)):
            x = rk4_step(lambda y: np.array(f(list(y), [rate, push], p)), x, STEP)  # noqa: B023
        steered.append((before + x[2]) / 2)
    return np.array(rows), np.array(steered), p.m
