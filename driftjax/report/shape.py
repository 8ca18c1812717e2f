"""Shape of the car in drawings: outline and wheels."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from driftjax.vehicle import VehicleConfig


def rotation(angle: ArrayLike) -> np.ndarray:
    """Return the matrix (2, 2) that turns a vector to the left by `angle` [rad]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def body(vehicle: VehicleConfig) -> np.ndarray:
    """Return the corners (6, 2) of the car in its own axes [m]; its nose is narrower, its overhangs are equal."""
    middle = (vehicle.a - vehicle.b) / 2
    front, back, half = middle + vehicle.length / 2, middle - vehicle.length / 2, vehicle.width / 2
    u = [back, front - half, front, front, front - half, back]
    v = [half, half, half / 2, -half / 2, -half, -half]
    return np.stack([u, v], axis=1)


def outline(x: ArrayLike, y: ArrayLike, psi: ArrayLike, vehicle: VehicleConfig) -> np.ndarray:
    """Return the corners (6, 2) of the car [m] at a pose."""
    return body(vehicle) @ rotation(psi).T + np.array([x, y])


def wheels(vehicle: VehicleConfig) -> dict[str, Any]:
    """Return the middles of the wheels in the car's axes, front ones first, and length and width of a wheel [m]."""
    half = 0.42 * vehicle.width
    places = [(u, v) for u in (vehicle.a, -vehicle.b) for v in (half, -half)]
    return {"places": places, "length": 0.15 * vehicle.length, "width": 0.14 * vehicle.width}


def wheel_corners(x: float, y: float, psi: float, delta: float, vehicle: VehicleConfig) -> list[np.ndarray]:
    """Return the corners (4, 2) of the four wheels [m], the front ones steered by `delta` [rad]."""
    shape = wheels(vehicle)
    long, wide = shape["length"] / 2, shape["width"] / 2
    rim = np.array([[long, wide], [long, -wide], [-long, -wide], [-long, wide]])
    steered = [(place, delta if k < 2 else 0.0) for k, place in enumerate(shape["places"])]
    return [(place + rim @ rotation(angle).T) @ rotation(psi).T + [x, y] for place, angle in steered]
