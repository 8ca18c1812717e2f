"""Drive plans on the car and log them: commands held between samples, sensors that are not ideal, CSV. NumPy only."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.independent.car import PSI, VX, VY, Car, G, R, X, Y
from experiments.independent.driver import MANOEUVRES, Limits, Plan

STEP = 5e-4  # of the integration, at most [s]
FILTER = 0.1  # time constant of the driver's view of V, beta and r over sqrt(L/g) [-]
SPUN, STOPPED = 1.2, 0.3  # sideslip [rad] and speed over sqrt(g L) at which a run is lost
ATTEMPTS = 6  # at a run that is lost
MOTION = ("V", "beta", "r")
FURTHER = ("x", "y", "psi", "ax", "ay")
COLUMNS = ("t", *MOTION, "delta", "Fxr", *FURTHER)


@dataclass(frozen=True)
class Sensors:
    """Noise of the sensors, in units of the car where they have one: typical sizes are 1."""

    noise: float = 1.0
    """Of V, beta and r; 1: 0.009 sqrt(g L), 0.5 deg and 0.005 sqrt(g/L), 0.05 m/s, 0.5 deg, 0.5 deg/s of a sedan."""
    coloured: float = 0.5
    """Share of its variance that lasts for a while [-]."""
    correlation: float = 0.3
    """For how long [s]."""
    gusts: float = 0.5
    """Disturbance of the motion; 1: 0.009 g, 0.008 g and 0.03 g/L [-]."""
    dropouts: float = 0.0
    """Share of samples missing in V and beta together, and in r, in bursts [-]."""
    further: bool = True
    """Whether pose and accelerations are logged too."""


class Motion(NamedTuple):
    """True motion at every step of the integration."""

    z: np.ndarray  # (N + 1, 16, R)
    force: np.ndarray  # (N, 2, R) specific force over each step [m/s^2]
    command: np.ndarray  # (T, 2, R) held over each sample


def coloured(rng: np.random.Generator, shape: tuple[int, ...], samples: float) -> np.ndarray:
    """Return noise of unit variance whose first axis forgets within so many `samples`."""
    keep = np.exp(-1 / samples) if samples > 0 else 0.0
    white, out = rng.standard_normal(shape), np.empty(shape)
    out[0] = white[0]
    for k in range(1, shape[0]):
        out[k] = keep * out[k - 1] + np.sqrt(1 - keep**2) * white[k]
    return out


def sensor_noise(car: Car, sensors: Sensors, rng: np.random.Generator, T: int, num: int, dt: float) -> np.ndarray:
    """Return the noise (T, 3, R) of V, beta and r."""
    size = car.size
    sigma = sensors.noise * np.array([0.0092 * size.unit_speed, 0.0087, 0.0049 / size.unit_time])[:, None]
    slow = coloured(rng, (T, 3, num), sensors.correlation / dt)
    mixed = np.sqrt(sensors.coloured) * slow + np.sqrt(1 - sensors.coloured) * rng.standard_normal((T, 3, num))
    return sigma * mixed


class Actuation:
    """What reaches the steering gear of the command: a pure delay in whole steps, then play."""

    def __init__(self, car: Car, first: np.ndarray, h: float):
        self.play = car.strength("steer_backlash", "w")
        self.past = [first] * round(car.strength("steer_delay", "d") / h)
        self.angle = first

    def __call__(self, steer: np.ndarray) -> np.ndarray:
        """Return the angle (R,) that reaches the wheels when `steer` (R,) is commanded for one more step [rad]."""
        self.past.append(steer)
        late = self.past.pop(0)
        self.angle = np.clip(self.angle, late - self.play, late + self.play)
        return self.angle


def drive(
    car: Car, plans: list[Plan], limits: Limits, noise: np.ndarray, gusts: np.ndarray, dt: float, substeps: int
) -> Motion:
    """Drive all plans side by side; `noise` (T, 3, R) is the error of what the driver senses, `gusts` (T, 3, R)
    accelerations forwards, to the left and in yaw."""
    reference, ahead = (np.stack([plan[i] for plan in plans], -1) for i in (0, 1))
    K, h = np.stack([plan.gain for plan in plans], -1), dt / substeps
    rate, lower, upper = (bound[:, None] for bound in (dt * limits.rate, limits.lower, limits.upper))
    T, num = len(noise), len(plans)
    command = np.clip(ahead[0], lower, upper)
    state, seen = car.at(reference[0], command), reference[0]
    gear = Actuation(car, command[0], h)
    z, force = np.empty((T * substeps + 1, 16, num)), np.empty((T * substeps, 2, num))
    commands, z[0] = np.empty((T, 2, num)), state
    smooth = 1 - np.exp(-dt / (FILTER * car.size.unit_time))
    for k in range(T):
        motion = np.stack([np.hypot(state[VX], state[VY]), np.arctan2(state[VY], state[VX]), state[R]])
        seen = seen + smooth * (motion + noise[k] - seen)
        wish = ahead[k] - np.einsum("ijr,jr->ir", K, seen - reference[k])
        command = np.clip(np.clip(wish, command - rate, command + rate), lower, upper)
        commands[k] = command
        for i in range(k * substeps, (k + 1) * substeps):
            state, force[i] = car.step(state, gear(command[0]), command[1], gusts[k], h)
            z[i + 1] = state
    return Motion(z, force, commands)


def lost(car: Car, motion: Motion) -> np.ndarray:
    """Return which runs (R,) spun, stopped or overflowed."""
    vx, vy = motion.z[:, VX], motion.z[:, VY]
    slip, speed = np.abs(np.arctan2(vy, vx)).max(axis=0), np.hypot(vx, vy).min(axis=0)
    return ~((slip < SPUN) & (speed > STOPPED * car.size.unit_speed))


def sense(car: Car, motion: Motion, noise: np.ndarray, dt: float, substeps: int) -> dict[str, np.ndarray]:
    """Return measured V, beta and r (T, R): of a point off the centre, with bias, scale and delay."""
    s, at = car.strength, np.arange(len(noise)) * substeps
    vx = motion.z[:, VX] - s("imu_lever_arm", "l_y") * motion.z[:, R]
    vy = motion.z[:, VY] + s("imu_lever_arm", "l_x") * motion.z[:, R]
    read = {
        "V": np.hypot(vx, vy) * (1 + s("speed_scale")),
        "beta": np.arctan2(vy, vx) + s("sideslip_bias"),
        "r": motion.z[:, R] * (1 + s("gyro_scale")) + s("gyro_bias"),
    }
    late = {name: np.maximum(at - s("channel_delay", f"d_{name}") / dt * substeps, 0) for name in MOTION}
    steps = np.arange(len(vx))
    columns = {name: np.stack([np.interp(late[name], steps, y) for y in value.T], 1) for name, value in read.items()}
    return {name: columns[name] + noise[:, i] for i, name in enumerate(MOTION)}


def further(car: Car, motion: Motion, rng: np.random.Generator, noise: float, T: int, substeps: int):
    """Return pose and specific force (T, R); the latter is the mean since the last sample, as behind a filter."""
    at, num, L = np.arange(T) * substeps, motion.z.shape[-1], car.L
    sigma = noise * np.array([0.007 * L, 0.007 * L, 0.0035])
    pose = {name: motion.z[at, row] + s * rng.standard_normal((T, num))
            for name, row, s in zip(("x", "y", "psi"), (X, Y, PSI), sigma, strict=True)}  # fmt: skip
    mean = motion.force.reshape(T, substeps, 2, num).mean(axis=1)
    mean = np.concatenate([mean[:1], mean[:-1]]) + noise * 0.05 * rng.standard_normal((T, 2, num))
    return pose | {"ax": mean[:, 0], "ay": mean[:, 1]}


def gaps(rng: np.random.Generator, T: int, share: float) -> np.ndarray:
    """Return which samples (T,) are missing: bursts of 1 to 20, `share` of them in all, never the first or last."""
    missing = np.zeros(T, bool)
    while missing.mean() < share:
        at, length = rng.integers(1, T - 21), rng.integers(1, 21)
        missing[at : at + length] = True
    return missing


def record(
    car: Car, limits: Limits, manoeuvres: tuple[str, ...], sensors: Sensors, seed: int, duration: float = 10.0,
    rate: float = 100.0,
) -> dict[str, dict[str, np.ndarray]]:  # fmt: skip
    """Drive the manoeuvres and return each run's columns (T,) by its name; a lost run is driven again otherwise.

    A run that is lost `ATTEMPTS` times is left out.
    """
    t, dt, size = np.arange(round(duration * rate)) / rate, 1 / rate, car.size
    substeps, T = round(dt / STEP), len(t)
    pushes = sensors.gusts * np.array([[0.0092 * G], [0.0084 * G], [0.028 / size.unit_time**2]])
    left, runs = list(range(len(manoeuvres))), dict[str, dict[str, np.ndarray]]()
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng((seed, attempt))
        plans = [MANOEUVRES[manoeuvres[i]](size, rng, t) for i in left]
        noise = sensor_noise(car, sensors, rng, T, len(left), dt)
        gusts = pushes * coloured(rng, (T, 3, len(left)), 0.54 * size.unit_time / dt)
        motion = drive(car, plans, limits, noise, gusts, dt, substeps)
        columns = sense(car, motion, noise, dt, substeps)
        columns |= {"delta": motion.command[:, 0], "Fxr": motion.command[:, 1]}
        columns |= further(car, motion, rng, sensors.noise, T, substeps) if sensors.further else {}
        away = lost(car, motion)
        for k, i in enumerate(left):
            if not away[k]:
                run = {"t": t} | {name: np.array(value[:, k]) for name, value in columns.items()}
                for names in (("V", "beta"), ("r",)):
                    missing = gaps(rng, T, sensors.dropouts)
                    run |= {name: np.where(missing, np.nan, run[name]) for name in names}
                runs[f"{manoeuvres[i]}-{i + 1}"] = run
        left = [i for k, i in enumerate(left) if away[k]]
        if not left:
            break
    return {name: runs[name] for name in sorted(runs, key=lambda one: int(one.rpartition("-")[2]))}


def write_csv(path: Path, runs: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Write runs in the log format, missing values as empty cells."""
    names = [name for name in COLUMNS if all(name in run for run in runs.values())]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*names, "run"])
        for label, run in runs.items():
            rows = zip(*(run[name].tolist() for name in names), strict=True)
            writer.writerows([*("" if v != v else repr(v) for v in row), label] for row in rows)
