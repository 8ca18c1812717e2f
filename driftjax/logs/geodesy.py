"""Latitude and longitude to metres east and north of an origin."""

import numpy as np

# WGS 84 (NIMA TR8350.2, 2000)
RADIUS = 6378137.0  # m, at the equator
ECCENTRICITY_SQUARED = 6.69437999014e-3


def east_north(latitude: np.ndarray, longitude: np.ndarray, origin: tuple[float, float]) -> np.ndarray:
    """Return metres east and north (2, n) of `origin` (latitude, longitude), all angles in degrees, on the ellipsoid.

    The plane touches the ellipsoid at `origin`; 10 km away distances are 4 mm too short.
    """
    lat0, lon0 = np.radians(origin)
    offset = _cartesian(np.radians(latitude), np.radians(longitude)) - _cartesian(lat0, lon0)[:, None]
    east = np.array([-np.sin(lon0), np.cos(lon0), 0.0])
    north = np.array([-np.sin(lat0) * np.cos(lon0), -np.sin(lat0) * np.sin(lon0), np.cos(lat0)])
    return np.stack([east @ offset, north @ offset])


def _cartesian(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """Return the position on the ellipsoid (3, ...) [m] in the frame that turns with the earth."""
    across = RADIUS / np.sqrt(1 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)  # radius of curvature, east to west
    return np.stack([
        across * np.cos(latitude) * np.cos(longitude),
        across * np.cos(latitude) * np.sin(longitude),
        across * (1 - ECCENTRICITY_SQUARED) * np.sin(latitude),
    ])  # fmt: skip
