"""Compute corridor, drift device and initial guesses on the nodes along a track."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import BadInput
from driftjax.planner.config import PlanConfig
from driftjax.planner.problem import Stage
from driftjax.track import Track
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.single_track import G

DEVICE_OFF = -3.0  # slip bound that never binds [rad]


class TightCorner(NamedTuple):
    """A tight corner to be drifted, along the nodes' s."""

    start: float  # where it becomes tight [m]
    end: float  # [m]
    side: int  # +1 left-hand, -1 right-hand


@eqx.filter_jit
def _sample(track: Track, s: Array):
    return jax.vmap(track.pose)(s), jax.vmap(track.widths)(s)


def tight_corners(s: np.ndarray, kappa: np.ndarray, config: PlanConfig) -> list[TightCorner]:
    """Find runs of nodes tighter than `drift_radius` that turn by more than `drift_angle`."""
    side = np.where(np.abs(kappa) >= 1 / config.drift_radius, np.sign(kappa), 0).astype(int)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], side, [0]])))
    runs = [(a, b - 1) for a, b in zip(edges[:-1], edges[1:], strict=True) if side[a] != 0]
    ds = s[1] - s[0]
    turned = [abs(np.sum(kappa[a : b + 1])) * ds for a, b in runs]
    return [
        TightCorner(float(s[a]), float(s[b]), int(side[a]))
        for (a, b), angle in zip(runs, turned, strict=True)
        if angle >= config.drift_angle and b > a
    ]


def device(s: np.ndarray, corners: list[TightCorner], config: PlanConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `(side, slip, beta_max)` at the nodes; drift corners require -side beta >= slip, ramped up to beta_d.

    Sideslip beyond `beta_normal` is allowed only in these corners and their surroundings.
    """
    side, slip, beta_max = np.ones_like(s), np.full_like(s, DEVICE_OFF), np.full_like(s, config.beta_normal)
    for c in corners if config.drift else []:
        share = (s - c.start) / (c.end - c.start)
        rise = np.clip(np.minimum(share - config.drift_from, config.drift_to - share) / config.drift_ramp, 0.0, 1.0)
        side = np.where(rise > 0, c.side, side)
        slip = np.where(rise > 0, config.beta_d * rise, slip)
        near = (share >= -config.drift_reach) & (share <= 1 + config.drift_reach)
        beta_max = np.where(near, config.beta_max, beta_max)
    return side, slip, beta_max


def stages(track: Track, vehicle: VehicleConfig, config: PlanConfig, s: np.ndarray) -> tuple[Stage, list[TightCorner]]:
    """Compute corridor and device at nodes `s`; raises `BadInput` where the car and its margin do not fit."""
    ds = s[1] - s[0]
    fine = np.arange(2 * len(s) + 1) * ds / 2 + s[0]
    (_, _, _, kappa), (w_right, w_left) = jax.tree.map(np.asarray, _sample(track, jnp.asarray(fine)))
    keep = vehicle.width / 2 + config.margin
    e_min, e_max = -w_right[:-1:2] + keep, w_left[:-1:2] - keep
    if np.any(e_min >= e_max):
        at = s[int(np.argmax(e_min - e_max))]
        raise BadInput(
            f"track at s = {at:.4g} m: no room for a car {vehicle.width:g} m wide with a margin of {config.margin:g} m;"
            " widen the track or lower 'margin'."
        )
    corners = tight_corners(s, kappa[:-1:2], config)
    side, slip, beta_max = device(s, corners, config)
    share = np.ones_like(s)
    share[[0, -1]] = 0.5
    kappas = np.stack([kappa[:-2:2], kappa[1:-1:2], kappa[2::2]], axis=1)
    return Stage(*map(jnp.asarray, (kappas, e_min, e_max, side, slip, beta_max, share))), corners


def speed_profile(s: np.ndarray, kappa: np.ndarray, vehicle: VehicleConfig, config: PlanConfig) -> np.ndarray:
    """Return the speed [m/s] on the centre line at 0.85 mu g lateral acceleration, braking and accelerating gently."""
    radius = 1 / np.maximum(np.abs(kappa), 1e-6)
    square = np.minimum(0.85 * vehicle.mu * G * radius, (0.95 * config.V_max) ** 2)
    brake, drive = 0.6 * abs(vehicle.Fxr_min) / vehicle.m, 0.6 * vehicle.Fxr_max / vehicle.m
    square = np.minimum.accumulate((square + 2 * brake * s)[::-1])[::-1] - 2 * brake * s
    square[0] = config.entry_speed**2
    square = np.minimum.accumulate(square - 2 * drive * s) + 2 * drive * s
    return np.clip(np.sqrt(np.maximum(square, 0)), 1.05 * config.V_min, 0.95 * config.V_max)


def guesses(
    s: np.ndarray, stage: Stage, corners: list[TightCorner], vehicle: VehicleConfig, config: PlanConfig
) -> np.ndarray:
    """Return guesses (2, n, 7) in SI on the centre line: gripping everywhere, and drifting in the drift corners."""
    kappa = np.asarray(stage.kappa[:, 0])
    V = speed_profile(s, kappa, vehicle, config)
    wheelbase = vehicle.a + vehicle.b
    # 0.1 rad of slip is about the peak of a dry tyre
    load = np.clip(V**2 * kappa / (vehicle.mu * G), -1, 1)
    beta = vehicle.b * kappa - 0.08 * load
    F = vehicle.m * np.clip(V * np.gradient(V, s), 0.5 * vehicle.Fxr_min / vehicle.m, 0.8 * vehicle.Fxr_max / vehicle.m)
    grip = np.stack([V, beta, V * kappa, 0 * V, -beta, wheelbase * kappa, F], axis=1)
    weight = np.zeros_like(s)
    for c in corners:
        ramp = 0.25 * (c.end - c.start)
        rise = np.clip(np.minimum((s - c.start + ramp / 2) / ramp, (c.end + ramp / 2 - s) / ramp), 0, 1)
        weight += c.side * rise
    slip = -max(1.2 * config.beta_d, 0.3) * weight
    delta = np.clip(slip + vehicle.a * kappa + 0.1 * weight, -0.9 * vehicle.delta_max, 0.9 * vehicle.delta_max)
    sideways = np.stack(
        [0.95 * V, slip, 0.95 * V * kappa, 0 * V, -slip, delta, np.full_like(V, 0.9 * vehicle.Fxr_max)], axis=1
    )
    w = np.abs(weight)[:, None]
    return np.stack([grip, (1 - w) * grip + w * sideways])
