"""Library of manoeuvres that separate effects: steady and excited drifts, and driving with grip."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.control.lqr import lqr
from driftjax.core import RESULTS, BadInput
from driftjax.equilibrium import Branch, SlipRadius, solve_nominal
from driftjax.parallel import call
from driftjax.sim.record import Manoeuvre
from driftjax.vehicle.effect import reference
from driftjax.vehicle.parameters import VehicleConfig
from driftjax.vehicle.single_track import G, SingleTrack

STEER, DRIVE = 0.05, 0.06  # size of the excitation: steering [rad], drive force over weight


class VehicleUnits(NamedTuple):
    """Units that scale a manoeuvre to a car."""

    length: float  # wheelbase [m]
    time: float  # sqrt(L / g) [s]
    speed: float  # sqrt(g L) [m/s]
    weight: float  # [N]


class NoDrift(BadInput):
    """A car without the drift equilibrium that a manoeuvre holds."""


def vehicle_units(vehicle: VehicleConfig) -> VehicleUnits:
    """Return the units of a car."""
    return VehicleUnits(*(reference(vehicle, of) for of in ("length", "time", "speed", "force")))


def multisine(rng: np.random.Generator, t: np.ndarray, slowest: float, fastest: float, num: int = 5) -> np.ndarray:
    """Return a sum of sines with random phases at `num` frequencies [Hz], of unit standard deviation."""
    frequencies = np.geomspace(slowest, fastest, num) * rng.uniform(0.9, 1.1, num)
    phases = rng.uniform(0, 2 * np.pi, num)
    return np.sqrt(2 / num) * np.sum(np.sin(2 * np.pi * np.outer(t, frequencies) + phases), axis=1)


def _hold(nominal: SingleTrack, at: Array, Q: Array, R_u: Array, dt: Array) -> tuple[Array, Array, Array, Array]:
    """Return state and input of the drift with slip and radius `at`, the LQR's gain there, and whether there is one."""
    steady = solve_nominal(nominal, SlipRadius(at[0], at[1]), branch=Branch.COUNTERSTEER)
    gain = lqr(nominal, steady.x, steady.u, Q, R_u, dt)
    return jnp.stack(steady.x), jnp.stack(steady.u), gain, steady.result == RESULTS.successful


def drift(vehicle: VehicleConfig, rng: np.random.Generator, t: np.ndarray, excited: bool = True) -> Manoeuvre:
    """Plan a drift on a circle, left or right, stabilised by an LQR; if `excited`, steering and drive vary."""
    unit, nominal, turn = vehicle_units(vehicle), vehicle.build(), rng.choice([-1.0, 1.0])
    beta, R = -turn * rng.uniform(0.38, 0.5), turn * unit.length * rng.uniform(3.5, 9.0)
    Q = jnp.array([(10 / unit.speed) ** 2, 10.0**2, (5 * unit.time) ** 2])
    R_u = jnp.array([10.0**2, (5 / unit.weight) ** 2])
    x, u, K, converged = call(_hold, nominal, jnp.array([beta, R]), Q, R_u, jnp.asarray(t[1] - t[0]))
    if not converged:
        raise NoDrift(f"vehicle {vehicle.name}: it has no drift equilibrium; give 'combined_slip' or another tyre.")
    wiggle = np.zeros((len(t), 2))
    if excited:
        low, high = 0.12 / unit.time, 0.9 / unit.time
        wiggle[:, 0] = STEER * multisine(rng, t, low, high)
        wiggle[:, 1] = DRIVE * unit.weight * multisine(rng, t, low / 2, high / 2)
    return Manoeuvre(jnp.broadcast_to(x, (len(t), 3)), u + wiggle, K, jnp.asarray(2 * np.pi * abs(R)))


def steady_drift(vehicle: VehicleConfig, rng: np.random.Generator, t: np.ndarray) -> Manoeuvre:
    """Plan a drift without excitation."""
    return drift(vehicle, rng, t, excited=False)


def _cruise(vehicle: VehicleConfig, speed: np.ndarray, steer: np.ndarray, push: np.ndarray, hold: bool = True):
    """Plan open-loop steering [rad] and drive [N] at a speed [m/s] that a feedback holds."""
    unit = vehicle_units(vehicle)
    x = np.stack([speed, np.zeros_like(speed), np.zeros_like(speed)], axis=1)
    gain = 0.5 * vehicle.m / unit.time if hold else 0.0
    K = np.array([[0.0, 0.0, 0.0], [gain, 0.0, 0.0]])
    return Manoeuvre(*map(jnp.asarray, (x, np.stack([steer, push], axis=1), K, 40 * unit.length)))


def _steer_for(vehicle: VehicleConfig, speed: float, share: float) -> float:
    """Return the steering angle [rad] at which a car with linear tyres uses `share` of its friction."""
    return min(share * vehicle.mu * G * (vehicle.a + vehicle.b) / speed**2 * 1.3, 0.5 * vehicle.delta_max)


def grip_sine(vehicle: VehicleConfig, rng: np.random.Generator, t: np.ndarray) -> Manoeuvre:
    """Plan cornering with grip: multisines in steering and drive."""
    unit = vehicle_units(vehicle)
    speed = unit.speed * rng.uniform(2.2, 4.2)
    steer = 0.6 * _steer_for(vehicle, speed, 0.6) * multisine(rng, t, 0.12 / unit.time, 0.8 / unit.time)
    push = 0.12 * unit.weight * multisine(rng, t, 0.06 / unit.time, 0.4 / unit.time)
    return _cruise(vehicle, np.full(len(t), speed), steer, push)


def slalom(vehicle: VehicleConfig, rng: np.random.Generator, t: np.ndarray) -> Manoeuvre:
    """Plan a steering sine of growing frequency at constant speed."""
    unit = vehicle_units(vehicle)
    speed = unit.speed * rng.uniform(1.6, 2.4)
    slow, fast = 0.1 / unit.time, 0.8 / unit.time
    phase = 2 * np.pi * (slow * t + (fast - slow) * t**2 / (2 * t[-1]))
    return _cruise(vehicle, np.full(len(t), speed), _steer_for(vehicle, speed, 0.6) * np.sin(phase), 0 * t)


def step_steer(vehicle: VehicleConfig, rng: np.random.Generator, t: np.ndarray) -> Manoeuvre:
    """Plan steering steps to both sides and back."""
    unit = vehicle_units(vehicle)
    speed = unit.speed * rng.uniform(1.6, 2.4)
    levels = rng.permutation(np.array([0.0, 0.7, -0.7, 0.4, -0.4, 0.0]))
    index = np.minimum((t / t[-1] * len(levels)).astype(int), len(levels) - 1)
    return _cruise(vehicle, np.full(len(t), speed), _steer_for(vehicle, speed, 0.7) * levels[index], 0 * t)


def throttle_steps(vehicle: VehicleConfig, rng: np.random.Generator, t: np.ndarray) -> Manoeuvre:
    """Plan steps of drive and brake while cornering gently."""
    unit = vehicle_units(vehicle)
    speed = unit.speed * rng.uniform(2.0, 3.6)
    levels = rng.permutation(np.array([0.25, -0.2, 0.15, -0.1, 0.2, -0.15, 0.0]))
    index = np.minimum((t / t[-1] * len(levels)).astype(int), len(levels) - 1)
    steer = _steer_for(vehicle, speed, 0.25) * multisine(rng, t, 0.1 / unit.time, 0.3 / unit.time)
    return _cruise(vehicle, np.full(len(t), speed), steer, 0.6 * unit.weight * levels[index])


def coast_down(vehicle: VehicleConfig, rng: np.random.Generator, t: np.ndarray) -> Manoeuvre:
    """Plan rolling straight without drive from a high speed."""
    speed = vehicle_units(vehicle).speed * rng.uniform(3.0, 4.0)
    return _cruise(vehicle, np.full(len(t), speed), 0 * t, 0 * t, hold=False)


def laps(vehicle: VehicleConfig, rng: np.random.Generator, t: np.ndarray) -> Manoeuvre:
    """Plan laps of an oval with grip, slower in its two turns; steered by its curvature, without path feedback."""
    unit, turn = vehicle_units(vehicle), rng.choice([-1.0, 1.0])
    R, straight = unit.length * rng.uniform(8, 12), unit.length * rng.uniform(10, 16)
    half, slow = straight + np.pi * R, np.sqrt(0.45 * vehicle.mu * G * R)
    along, speed, dt = 0.0, np.zeros(len(t)), t[1] - t[0]
    curvature = np.zeros(len(t))
    for i in range(len(t)):  # the straight comes first, the turn after it; twice a lap
        there = along % half
        speed[i] = slow * (1 + 0.25 * np.sin(np.pi * min(there / straight, 1.0)) ** 2)
        curvature[i] = (
            turn / R * np.clip((there - straight) / unit.length, 0, 1) * np.clip((half - there) / unit.length, 0, 1)
        )
        along += speed[i] * dt
    x = np.stack([speed, np.zeros(len(t)), speed * curvature], axis=1)
    steer = np.arctan((vehicle.a + vehicle.b) * curvature) * 1.1  # tyres slip
    K = np.array([[0.0, 0.0, 0.2 * unit.time], [0.5 * vehicle.m / unit.time, 0.0, 0.0]])
    u = np.stack([steer, vehicle.m * np.gradient(speed, t)], axis=1)
    return Manoeuvre(*map(jnp.asarray, (x, u, K, 2 * half)))


MANOEUVRES: dict[str, Callable[[VehicleConfig, np.random.Generator, np.ndarray], Manoeuvre]] = {
    "drift": drift,
    "steady_drift": steady_drift,
    "grip_sine": grip_sine,
    "slalom": slalom,
    "step_steer": step_steer,
    "throttle_steps": throttle_steps,
    "coast_down": coast_down,
    "laps": laps,
}
RICH = ("drift", "drift", "drift", "drift", "grip_sine", "throttle_steps")  # the standard 60 s
