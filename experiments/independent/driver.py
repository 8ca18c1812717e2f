"""Manoeuvres of a driver who knows the nominal car: what to command, and how to correct it by what is measured.

Commands are feedforward minus gain times the departure of the measured V, beta and r from a reference. Sizes are in
units of the car: sqrt(L/g), sqrt(g L), its weight. NumPy only.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from experiments.independent.car import VX, VY, Car, G, R, Size

DRIFT_WEIGHTS = (10.0, 10.0, 5.0)  # on V, beta and r in units of the car
COMMAND_WEIGHTS = (10.0, 5.0)  # on steering [rad] and drive over weight
HOLD = 0.4  # drive force per departure of the speed, over m sqrt(g/L)


class Limits(NamedTuple):
    """What a driver can command."""

    lower: np.ndarray  # (2,) steering [rad] and drive [N]
    upper: np.ndarray
    rate: np.ndarray  # (2,) per second


class Plan(NamedTuple):
    """One run."""

    reference: np.ndarray  # (T, 3) V, beta, r
    command: np.ndarray  # (T, 2) steering [rad], drive [N]
    gain: np.ndarray  # (2, 3)


def rates_of(car: Car, motion: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Return the rates (3,) of V, beta and r in one motion (3,) under one command (2,)."""
    z, (V, beta, _) = car.at(motion[:, None], command[:, None]), motion
    rate = car.rates(z, command[:1], command[1:], np.zeros((3, 1)))[0]
    dvx, dvy, dr = rate[[VX, VY, R], 0]
    return np.array([dvx * np.cos(beta) + dvy * np.sin(beta), (dvy * np.cos(beta) - dvx * np.sin(beta)) / V, dr])


def slopes(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the derivatives of `function` at `at` by central differences of 1e-6 `size`."""
    steps = 1e-6 * np.diag(size)
    return np.stack([(function(at + d) - function(at - d)) / (2e-6 * s) for d, s in zip(steps, size, strict=True)], 1)


def steady_drift(size: Size, beta: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return motion (3,) and command (2,) of the nominal drift with sideslip `beta` [rad] round `radius` [m], both
    signed, by Newton's method from a slide at 0.85 of the friction. Raises `ValueError` where there is none."""
    car, turn = Car(size, {}), np.sign(radius)
    V = np.sqrt(0.85 * size.mu * G * abs(radius))
    delta = beta + size.a / radius + turn * 0.8 / size.B
    unit = np.array([size.unit_speed, 1.0, size.m * G])
    unknown = np.array([V, delta, 0.25 * size.m * G])
    scale = np.array([size.unit_speed / size.unit_time, 1 / size.unit_time, 1 / size.unit_time**2])
    error = lambda p: rates_of(car, np.array([p[0], beta, p[0] / radius]), p[1:]) / scale
    for _ in range(30):
        now = error(unknown)
        if np.abs(now).max() < 1e-9:
            return np.array([unknown[0], beta, unknown[0] / radius]), unknown[1:]
        step = np.linalg.solve(slopes(error, unknown, unit) * unit, -now)
        unknown = unknown + unit * step * min(1.0, 0.2 / np.abs(step).max())
    raise ValueError(f"no drift at {beta:.2f} rad round {radius:.1f} m")


def regulator(size: Size, motion: np.ndarray, command: np.ndarray, dt: float) -> np.ndarray:
    """Return the gain (2, 3) that holds the nominal car there, by iterating the Riccati equation of Euler's steps."""
    car, unit = Car(size, {}), np.array([1.0, size.m * G])
    units = np.array([size.unit_speed, 1.0, 1 / size.unit_time])
    A = np.eye(3) + dt * slopes(lambda x: rates_of(car, x, command), motion, units)
    B = dt * slopes(lambda u: rates_of(car, motion, u), command, unit)
    Q, weight = np.diag((np.array(DRIFT_WEIGHTS) / units) ** 2), np.diag((np.array(COMMAND_WEIGHTS) / unit) ** 2)
    P, K = Q, np.zeros((2, 3))
    for _ in range(3000):
        K = np.linalg.solve(weight + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ K)
    return K


def wiggle(rng: np.random.Generator, t: np.ndarray, slowest: float, fastest: float, num: int = 4) -> np.ndarray:
    """Return a sum of `num` sines of random phase between two frequencies [Hz], of unit standard deviation."""
    frequency = np.exp(np.sort(rng.uniform(np.log(slowest), np.log(fastest), num)))
    return np.sqrt(2 / num) * np.sin(2 * np.pi * (t[:, None] * frequency + rng.random(num))).sum(axis=1)


def drift(size: Size, rng: np.random.Generator, t: np.ndarray) -> Plan:
    """Hold a drift while steering and drive are excited."""
    turn = rng.choice([-1.0, 1.0])
    radius = turn * (size.a + size.b) * rng.uniform(4, 10)
    motion, command = steady_drift(size, -turn * rng.uniform(0.3, 0.5), radius)
    stir = np.stack([0.05 * wiggle(rng, t, 0.1 / size.unit_time, 0.7 / size.unit_time),
                     0.06 * size.m * G * wiggle(rng, t, 0.05 / size.unit_time, 0.4 / size.unit_time)], 1)  # fmt: skip
    return Plan(np.tile(motion, (len(t), 1)), command + stir, regulator(size, motion, command, t[1] - t[0]))


def cruise(size: Size, speed: np.ndarray, steer: np.ndarray, push: np.ndarray, hold: float = HOLD) -> Plan:
    """Apply planned steering and drive; feedback on the drive holds the speed (T,)."""
    still = np.zeros_like(speed)
    gain = np.array([[0.0, 0.0, 0.0], [hold * size.m / size.unit_time, 0.0, 0.0]])
    return Plan(np.stack([speed, still, still], 1), np.stack([steer, push], 1), gain)


def steer_for(size: Size, speed: float, share: float) -> float:
    """Return the steering angle [rad] that corners at `share` of the friction, by the slips of the nominal tyres."""
    need = share * size.mu * G
    return float(min((size.a + size.b) * need / speed**2 * 1.2, 0.35))


def chirp(size: Size, rng: np.random.Generator, t: np.ndarray) -> Plan:
    """Sweep the frequency of the steering."""
    speed = size.unit_speed * rng.uniform(1.6, 3.2)
    slow, fast = 0.08 / size.unit_time, 0.9 / size.unit_time
    phase = 2 * np.pi * slow * t[-1] / np.log(fast / slow) * ((fast / slow) ** (t / t[-1]) - 1)
    steer = rng.choice([-1, 1]) * steer_for(size, speed, 0.6) * np.sin(phase)
    return cruise(size, np.full(len(t), speed), steer, 0 * t)


def slalom(size: Size, rng: np.random.Generator, t: np.ndarray) -> Plan:
    """Weave with growing steering angle."""
    speed, frequency = size.unit_speed * rng.uniform(1.8, 2.8), rng.uniform(0.25, 0.4) / size.unit_time
    grow = steer_for(size, speed, 0.9) * (0.2 + 0.8 * t / t[-1])
    return cruise(size, np.full(len(t), speed), grow * np.sin(2 * np.pi * frequency * t), 0 * t)


def lane_changes(size: Size, rng: np.random.Generator, t: np.ndarray) -> Plan:
    """Change lanes abruptly, each time further."""
    speed, length = size.unit_speed * rng.uniform(1.8, 3.0), 5 * size.unit_time
    side = np.where(t % (2 * length) < length, 1.0, -1.0) * (t % length < 0.6 * length)
    size_of = np.minimum(0.3 + 0.12 * (t // (2 * length)), 0.8)
    return cruise(size, np.full(len(t), speed), steer_for(size, speed, 0.9) * size_of * side, 0 * t)


def throttle_steps(size: Size, rng: np.random.Generator, t: np.ndarray) -> Plan:
    """Drive and brake in steps in a gentle turn."""
    speed = size.unit_speed * rng.uniform(2.2, 3.6)
    levels = rng.permutation([0.24, -0.2, 0.18, -0.12, 0.14, -0.16, 0.0, 0.08])
    push = size.m * G * levels[np.minimum((t / t[-1] * len(levels)).astype(int), len(levels) - 1)]
    steer = steer_for(size, speed, 0.3) * wiggle(rng, t, 0.06 / size.unit_time, 0.3 / size.unit_time)
    return cruise(size, np.full(len(t), speed), steer, push, HOLD / 4)


def circle(size: Size, rng: np.random.Generator, t: np.ndarray) -> Plan:
    """Drive round a circle of constant radius, faster and faster up to 0.85 of the friction."""
    radius, turn = (size.a + size.b) * rng.uniform(10, 16), rng.choice([-1.0, 1.0])
    speed = np.sqrt(size.mu * G * radius * (0.15 + 0.7 * t / t[-1]))
    steer = np.full(len(t), turn * np.arctan((size.a + size.b) / radius))
    plan = cruise(size, speed, steer, size.m * np.gradient(speed, t))
    plan.reference[:, 2] = turn * speed / radius
    plan.gain[0, 2] = 0.15 * size.unit_time
    return plan


def coast(size: Size, rng: np.random.Generator, t: np.ndarray) -> Plan:
    """Roll without drive from a high speed, steering a little."""
    speed = size.unit_speed * rng.uniform(3.0, 4.0)
    steer = steer_for(size, speed, 0.2) * wiggle(rng, t, 0.05 / size.unit_time, 0.2 / size.unit_time)
    return cruise(size, np.full(len(t), speed), steer, 0 * t, 0.0)


MANOEUVRES = {one.__name__: one for one in (drift, chirp, throttle_steps, circle, lane_changes, slalom, coast)}
CAMPAIGN = ("drift", "chirp", "throttle_steps", "drift", "circle", "lane_changes", "drift", "slalom", "drift",
            "throttle_steps", "coast", "drift")  # fmt: skip
