"""Recordings of made-up drives, as an F1TENTH car's ROS 2 bag and as a file saved from MATLAB."""

from pathlib import Path

import numpy as np
import scipy.io
from logs import bags
from rosbags.typesys import get_types_from_msg

ACKERMANN = "ackermann_msgs/msg/AckermannDrive"
FIELDS = "\n".join(
    f"float32 {name}" for name in ("steering_angle", "steering_angle_velocity", "speed", "acceleration", "jerk")
)
bags.ROS2.register(
    get_types_from_msg(FIELDS, ACKERMANN)
    | get_types_from_msg(f"std_msgs/Header header\n{ACKERMANN} drive", f"{ACKERMANN}Stamped")
)


def steered(t: np.ndarray, size: float) -> np.ndarray:
    """Steering of two frequencies [rad]."""
    return size * (0.7 * np.sin(1.3 * t) + 0.3 * np.sin(3.1 * t + 1))


def driven(rates, t: np.ndarray, x: np.ndarray, substeps: int) -> np.ndarray:
    """States (len(t), n) of dx/dt = rates(t, x) by Heun's rule."""
    states, dt = [x], (t[1] - t[0]) / substeps
    for start in t[:-1]:
        for now in start + dt * np.arange(substeps):
            first = rates(now, x)
            x = x + dt / 2 * (first + rates(now + dt, x + dt * first))
        states.append(x)
    return np.array(states)


def single_track(m: float, Iz: float, a: float, b: float, stiffness: float, drag: float, force, steer):
    """Rates of (vx, vy, r, x, y, psi) of a car with linear tyres of an axle's `stiffness` [N/rad], driven in front."""

    def rates(t: float, s: np.ndarray) -> np.ndarray:
        vx, vy, r, _, _, psi = s
        delta, F = steer(t), force(t)
        Ff, Fr = stiffness * (delta - (vy + a * r) / vx), stiffness * (b * r - vy) / vx
        return np.array([
            vy * r + (F * np.cos(delta) - Ff * np.sin(delta) - drag * vx**2) / m,
            -vx * r + (F * np.sin(delta) + Ff * np.cos(delta) + Fr) / m,
            (a * (F * np.sin(delta) + Ff * np.cos(delta)) - b * Fr) / Iz,
            vx * np.cos(psi) - vy * np.sin(psi), vx * np.sin(psi) + vy * np.cos(psi), r,
        ])  # fmt: skip

    return rates


def f1tenth_bag(path: Path, stiffness: float = 45.0, seed: int = 0) -> None:
    """25 s of an F1TENTH car: odometry of its state estimate, the VESC's IMU and the drive commands."""
    t, rng = np.arange(0, 25, 0.02), np.random.default_rng(seed)
    force, steer = lambda t: 3 * np.sin(0.4 * t) + 2, lambda t: steered(t, 0.15)
    rates = single_track(3.47, 0.047, 0.159, 0.171, stiffness, 0.2, force, steer)
    states = driven(rates, t, np.array([3.0, 0, 0, 0, 0, 0.3]), substeps=4)
    vx, vy, r, x, y, psi = states.T
    ax, ay = (np.gradient(vx, t) - vy * r, np.gradient(vy, t) + vx * r)
    noisy = lambda values, size: values + size * rng.standard_normal(len(t))
    ns = (1e9 * t).astype(np.int64)
    pose, twist = "pose.pose", "twist.twist"
    odometry = {
        f"{pose}.position.x": noisy(x, 0.01), f"{pose}.position.y": noisy(y, 0.01),
        f"{pose}.orientation.yaw": noisy(psi, 0.005), f"{twist}.linear.x": noisy(vx, 0.03),
        f"{twist}.linear.y": noisy(vy, 0.02), f"{twist}.angular.z": noisy(r, 0.02),
    }  # fmt: skip
    imu = {
        "angular_velocity.z": noisy(r, 0.02), "linear_acceleration.x": noisy(ax, 0.1),
        "linear_acceleration.y": noisy(ay, 0.1),
    }  # fmt: skip
    command = {"drive.steering_angle": steer(t), "drive.speed": vx + 0.2}
    sources = [
        bags.Source("/car_state/odom", "nav_msgs/msg/Odometry", ns, odometry),
        bags.Source("/sensors/imu/raw", "sensor_msgs/msg/Imu", ns, imu),
        bags.Source("/drive", f"{ACKERMANN}Stamped", ns, command),
    ]
    bags.write_ros2(path, sources)


def vehicle_mat(path: Path) -> None:
    """The simulation of MATLAB's idnlgrey example with stiff tyres, its state `x`, inputs `u` and outputs `y`."""
    m, a, b, Cx, Cy, drag = 1700.0, 1.5, 1.5, 2e5, 5e4, 0.5  # Iz = m ((a + b) / 2)^2; the example begins at 1.5e5, 4e4
    t, rng = np.arange(0, 60, 0.1), np.random.default_rng(0)
    slip, steer = lambda t: 0.002 + 0.003 * np.sin(0.5 * t), lambda t: steered(t, 0.04)
    force = lambda t: 2 * Cx * slip(t)  # of both front wheels
    rates = single_track(m, m * ((a + b) / 2) ** 2, a, b, 2 * Cy, drag, force, steer)
    states = driven(rates, t, np.array([15.0, 0, 0, 0, 0, 0]), substeps=10)
    vx, vy, r = states[:, :3].T
    ay = np.array([rates(now, x)[1] for now, x in zip(t, states, strict=True)]) + vx * r
    measured = np.stack([vx, ay, r], axis=1) + rng.standard_normal((len(t), 3)) * [0.02, 0.02, 0.002]
    x = np.stack([vx, vy, r], axis=1) + rng.standard_normal((len(t), 3)) * [0.02, 0.02, 0.002]
    u = np.stack([slip(t), slip(t), 0 * t, 0 * t, steer(t)], axis=1)
    scipy.io.savemat(
        path, {"t": t[:, None], "x": x, "u1": u, "y1": measured, "F": 1.5e5 * u[:, :4].sum(axis=1)[:, None]}
    )
