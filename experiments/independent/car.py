"""A four-wheel car with everything that the nominal single track lacks, each with a strength of its own.

It shares no code with driftjax: NumPy only, Newton's law in body axes, wheel by wheel. Roll and pitch are oscillators
that the wheel loads follow, the drive torque is split between two wheels, tyres have a load and a slip each. With
nothing hidden it is the single track of Wu et al. 2025, Eq. 1-3. SI and radians, left positive (ISO 8855). Wheels are
front left, front right, rear left, rear right; the last axis of every array holds runs (R) driven side by side.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

G = 9.81  # gravitational acceleration [m/s^2]
LOAD_SENSITIVITY = 0.15  # relative fall of a wheel's friction per relative rise of its load [-]
LEAST_SHARE = 0.04  # square of the share of side force that no drive force takes away [-]
ROLL = (5.6, 0.35)  # natural frequency over sqrt(g/L), damping ratio
PITCH = (6.5, 0.4)
SWAY = 0.004  # how far the body leans out per lateral acceleration, over L/g [-]
AIR = (0.0014, 0.0028)  # wind force along and across over its speed squared, over m/L [-]
AIR_ARM = 1 / 8  # wheelbases from the centre of mass forward to where the wind acts
TURNING = 0.02  # yaw rate from which a differential knows the outer wheel, over sqrt(g/L) [-]
CREEP = 0.02  # speed from which the wheels roll, over sqrt(g L) [-]

PARAMETERS = dict.fromkeys(
    ("friction", "friction_front", "friction_rear", "stiffness_front", "stiffness_rear", "combined_slip", "drive_gain",
     "mass", "yaw_inertia", "cog_shift", "steer_offset", "steer_gain", "gyro_bias", "gyro_scale", "sideslip_bias",
     "speed_scale", "power_limit"), ("p",),
) | {
    "load_transfer_long": ("h",), "load_transfer_lat": ("k_f", "k_r"), "relaxation_length": ("sigma",),
    "aero_drag": ("c",), "rolling_resistance": ("f",), "drive_lag": ("tau",), "steer_lag": ("tau",),
    "steer_delay": ("d",), "steer_backlash": ("w",), "differential_moment": ("k",), "road_bank": ("phi",),
    "road_grade": ("grade_x", "grade_y"), "side_wind": ("w_x", "w_y"), "channel_delay": ("d_V", "d_beta", "d_r"),
    "imu_lever_arm": ("l_x", "l_y"),
}  # fmt: skip

X, Y, PSI, VX, VY, R, STEER, DRIVE, LEAN, LEAN_RATE, DIVE, DIVE_RATE = range(12)
SLIP = slice(12, 16)  # rows of the state (16, R) that hold the slip angle which each tyre feels
STEERED = np.array([1.0, 1.0, 0.0, 0.0])[:, None]
REAR = np.array([-1.0, -1.0, 1.0, 1.0])[:, None]
RIGHT = np.array([-1.0, 1.0, -1.0, 1.0])[:, None]


class Size(NamedTuple):
    """Numbers of the nominal car."""

    m: float  # mass [kg]
    Iz: float  # yaw inertia [kg m^2]
    a: float  # centre of mass to front axle [m]
    b: float  # centre of mass to rear axle [m]
    mu: float  # friction [-]
    B: float  # stiffness factor of the tyres [1/rad]
    C: float  # shape factor of the tyres [-]
    track: float  # distance between left and right wheels [m]

    @property
    def unit_time(self) -> float:
        """Return sqrt(L/g) [s]."""
        return ((self.a + self.b) / G) ** 0.5

    @property
    def unit_speed(self) -> float:
        """Return sqrt(g L) [m/s]."""
        return ((self.a + self.b) * G) ** 0.5


class Strengths:
    """Strengths of what is hidden: effect -> parameter -> value, SI; what is not given is neutral, 0."""

    def __init__(self, hidden: Mapping[str, Mapping[str, float]]):
        for effect, values in hidden.items():
            unknown = set(values) - set(PARAMETERS.get(effect, ()))
            if effect not in PARAMETERS or unknown:
                raise ValueError(f"{effect} {sorted(unknown)}: the plant hides {', '.join(PARAMETERS)}.")
        self.hidden = hidden

    def __call__(self, effect: str, parameter: str = "p") -> float:
        """Return the strength of a parameter, SI."""
        return float(self.hidden.get(effect, {}).get(parameter, 0.0))


class Forces(NamedTuple):
    """Forces in one state."""

    Fx: np.ndarray  # (4, R) along each wheel [N]
    Fy: np.ndarray  # (4, R) to its left [N]
    Fz: np.ndarray  # (4, R) load [N]
    mu: np.ndarray  # (4, R) friction of each wheel [-]
    ax: np.ndarray  # (R,) force along the body over the mass [m/s^2]
    ay: np.ndarray  # (R,) force to the left over the mass [m/s^2]
    moment: np.ndarray  # (R,) about the vertical axis [N m]
    slip_rate: np.ndarray  # (4, R) of the slip angle that each tyre feels [rad/s]


class Car:
    """The car with its hidden effects.

    `body` (0..1) scales what the catalogue has no word for: the track width in the slip angles, and the sideways
    inertia of a body that rolls.
    """

    def __init__(self, size: Size, hidden: Mapping[str, Mapping[str, float]], body: float = 0.0):
        s = self.strength = Strengths(hidden)
        self.size, self.body = size, body
        self.m, self.Iz = size.m * (1 + s("mass")), size.Iz * (1 + s("yaw_inertia"))
        self.a, self.b = size.a - s("cog_shift"), size.b + s("cog_shift")
        self.L = size.a + size.b
        self.px = np.array([self.a, self.a, -self.b, -self.b])[:, None]
        self.py = size.track / 2 * np.array([1.0, -1.0, 1.0, -1.0])[:, None]
        axles = lambda front, rear: np.array([front, front, rear, rear])[:, None]
        self.static = self.m * G / (2 * self.L) * axles(self.b, self.a)
        friction = size.mu * (1 + s("friction"))
        self.mu = friction * axles(1 + s("friction_front"), 1 + s("friction_rear"))
        self.B = size.B * axles(1 + s("stiffness_front"), 1 + s("stiffness_rear"))
        grip_lost = axles(s("load_transfer_lat", "k_f"), s("load_transfer_lat", "k_r"))
        self.lean_share = RIGHT * np.sqrt(grip_lost / LOAD_SENSITIVITY) / G  # of a wheel's load, per m/s^2
        self.dive_load = REAR * s("load_transfer_long", "h") * self.m / (2 * self.L)
        self.modes = [(w / size.unit_time, 2 * zeta * w / size.unit_time) for w, zeta in (ROLL, PITCH)]

    def at(self, motion: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return the state (16, R) at V, beta, r (3, R) with the actuators at their `command` (2, R), body level."""
        V, beta, r = motion
        z = np.zeros((16, len(V)))
        z[VX], z[VY], z[R] = V * np.cos(beta), V * np.sin(beta), r
        z[STEER], z[DRIVE] = command
        z[SLIP] = self.slip_angles(z, self.steered(z, command[0]))
        return z

    def steered(self, z: np.ndarray, steer: np.ndarray) -> np.ndarray:
        """Return the angle (R,) of the front wheels [rad]; `steer` is what reaches the steering gear."""
        turned = z[STEER] if self.strength("steer_lag", "tau") else steer
        return turned * (1 + self.strength("steer_gain")) + self.strength("steer_offset")

    def drive_force(self, z: np.ndarray, demand: np.ndarray) -> np.ndarray:
        """Return the force (R,) of drive and brake at the rear wheels [N], within the power of the engine."""
        force = z[DRIVE] if self.strength("drive_lag", "tau") else demand * (1 + self.strength("drive_gain"))
        slowness = self.strength("power_limit")
        return np.minimum(force, 1 / (slowness * np.maximum(z[VX], 0.1))) if slowness else force

    def slip_angles(self, z: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Return the geometric slip angle (4, R) of each wheel [rad]."""
        return np.arctan2(z[VY] + z[R] * self.px, z[VX] - self.body * z[R] * self.py) - STEERED * delta

    def forces(self, z: np.ndarray, delta: np.ndarray, drive: np.ndarray) -> Forces:
        """Return all forces in the states `z` at front wheel angle `delta` (R,) and rear drive force `drive` (R,)."""
        s, alpha = self.strength, self.slip_angles(z, delta)
        slip_rate, sigma = np.zeros_like(alpha), s("relaxation_length", "sigma")
        if sigma:
            slip_rate = np.hypot(z[VX], z[VY]) / sigma * (alpha - z[SLIP])
            alpha = z[SLIP]
        lean = np.clip(self.lean_share * z[LEAN], -1, 1)
        Fz = np.maximum((self.static + self.dive_load * z[DIVE]) * (1 + lean), 1e-3 * self.static)
        mu = self.mu * (1 - LOAD_SENSITIVITY * lean)
        outward = s("differential_moment", "k") / self.size.track * np.tanh(z[R] * self.size.unit_time / TURNING)
        Fx = np.where(REAR > 0, drive * (0.5 + RIGHT * outward), 0.0)
        left = np.maximum(1 - s("combined_slip") * (Fx / (mu * Fz)) ** 2, LEAST_SHARE)
        Fy = -mu * Fz * np.sin(self.size.C * np.arctan(self.B * alpha)) * np.sqrt(left)
        Fx = Fx - s("rolling_resistance", "f") * Fz * np.tanh(z[VX] / (CREEP * self.size.unit_speed))
        cos, sin = np.cos(STEERED * delta), np.sin(STEERED * delta)
        along, across = Fx * cos - Fy * sin, Fx * sin + Fy * cos
        air, blown = self.air(z)
        ax = (along.sum(axis=0) + air[0]) / self.m
        ay = (across.sum(axis=0) + air[1]) / self.m
        return Forces(Fx, Fy, Fz, mu, ax, ay, (self.px * across - self.py * along).sum(axis=0) + blown, slip_rate)

    def air(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return drag and wind, forwards and to the left (2, R) [N], and the moment of the wind (R,) [N m]."""
        v, s = z[VX : VY + 1], self.strength
        force = -s("aero_drag", "c") * np.hypot(*v) * v
        if "side_wind" not in s.hidden:
            return force, np.zeros_like(v[0])
        cos, sin, east, north = np.cos(z[PSI]), np.sin(z[PSI]), s("side_wind", "w_x"), s("side_wind", "w_y")
        through = np.stack([east * cos + north * sin, north * cos - east * sin]) - v
        size = np.array(AIR)[:, None] * self.size.m / self.L
        wind = size * (np.hypot(*through) * through + np.hypot(*v) * v)  # none in still air: that is drag
        return force + wind, AIR_ARM * self.L * wind[1]

    def road(self, psi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pull of gravity on a road that is not level, forwards and to the left (R,) [m/s^2]."""
        up, side, s = self.strength("road_grade", "grade_x"), self.strength("road_grade", "grade_y"), np.sin(psi)
        bank, c = np.sin(self.strength("road_bank", "phi")), np.cos(psi)
        return -G * (up * c + side * s), G * (up * s - side * c + bank)

    def rates(self, z: np.ndarray, steer: np.ndarray, demand: np.ndarray, gust: np.ndarray):
        """Return the rates (16, R) of the state, and the specific force (2, R) at the centre of mass [m/s^2].

        `steer` (R,) [rad] and `demand` (R,) [N] reach the actuators, `gust` (3, R) is a further acceleration forwards,
        to the left and in yaw.
        """
        delta, drive = self.steered(z, steer), self.drive_force(z, demand)
        force = self.forces(z, delta, drive)
        (stiff, damped), (stiff_pitch, damped_pitch) = self.modes
        lean_rate = stiff**2 * (force.ay - z[LEAN]) - damped * z[LEAN_RATE]
        dive_rate = stiff_pitch**2 * (force.ax - z[DIVE]) - damped_pitch * z[DIVE_RATE]
        ay = force.ay + self.body * SWAY * self.size.unit_time**2 * lean_rate
        down, aside = self.road(z[PSI])
        out, cos, sin = np.empty_like(z), np.cos(z[PSI]), np.sin(z[PSI])
        out[X], out[Y], out[PSI] = cos * z[VX] - sin * z[VY], sin * z[VX] + cos * z[VY], z[R]
        out[VX] = force.ax + down + gust[0] + z[R] * z[VY]
        out[VY] = ay + aside + gust[1] - z[R] * z[VX]
        out[R] = force.moment / self.Iz + gust[2]
        lags = self.strength("steer_lag", "tau"), self.strength("drive_lag", "tau")
        out[STEER] = (steer - z[STEER]) / lags[0] if lags[0] else 0.0
        out[DRIVE] = (demand * (1 + self.strength("drive_gain")) - z[DRIVE]) / lags[1] if lags[1] else 0.0
        out[LEAN], out[LEAN_RATE], out[DIVE], out[DIVE_RATE] = z[LEAN_RATE], lean_rate, z[DIVE_RATE], dive_rate
        out[SLIP] = force.slip_rate
        return out, np.stack([force.ax + gust[0], ay + gust[1]])

    def step(self, z: np.ndarray, steer: np.ndarray, demand: np.ndarray, gust: np.ndarray, h: float):
        """Return the state after `h` [s] by Heun's rule, and the specific force (2, R) over it [m/s^2]."""
        first, before = self.rates(z, steer, demand, gust)
        second, after = self.rates(z + h * first, steer, demand, gust)
        return z + h / 2 * (first + second), (before + after) / 2
