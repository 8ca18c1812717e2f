"""Units as logs spell them, and their factors to SI."""

import re
from typing import NamedTuple

import numpy as np

DEG = np.pi / 180
STANDARD_GRAVITY = 9.80665  # of the unit g [m/s^2]


class Unit(NamedTuple):
    """A unit of a dimension."""

    dimension: str
    factor: float
    """SI units or radians per unit."""


def _units(dimension: str, **factors: float) -> dict[str, Unit]:
    return {name: Unit(dimension, factor) for name, factor in factors.items()}


# spelt without signs between letters: m/s, m_s and m s-1 are ms1 or mps
UNITS: dict[str, Unit] = {
    **_units("speed", mps=1, kmh=1 / 3.6, kph=1 / 3.6, kmph=1 / 3.6, mph=0.44704, kn=1852 / 3600, knots=1852 / 3600),
    **_units("rate", radps=1, rads=1, degps=DEG, degs=DEG, dps=DEG, rpm=np.pi / 30),
    **_units("angle", rad=1, deg=DEG, degree=DEG, degrees=DEG, mrad=1e-3),
    **_units("length", m=1, km=1e3, cm=1e-2, mm=1e-3, ft=0.3048, meter=1, meters=1),
    **_units("acceleration", mps2=1, ms2=1, mpss=1, g=STANDARD_GRAVITY),
    **_units("force", n=1, kn_=1e3),
    **_units("time", s=1, sec=1, seconds=1, ms=1e-3, us=1e-6, ns=1e-9),
    **_units("other", radps2=1, rads2=1, degps2=1, nm=1, bar=1, c=1, v=1, percent=1, hz=1, pa=1, mpa=1, kg=1, w=1),
}  # fmt: skip
SYMBOLS = {"m/s": "mps", "m/s^2": "mps2", "m/s2": "mps2", "m/s/s": "mps2", "m/s²": "mps2", "km/h": "kmh",
           "rad/s": "radps", "deg/s": "degps", "°/s": "degps", "°": "deg", "rad/s^2": "radps2", "%": "percent",
           "kN": "kn_"}  # fmt: skip


def parse_unit(text: str) -> Unit | None:
    """Return the unit that a text such as `km/h` or `[deg/s]` means; None if it is unknown."""
    text = text.strip().strip("[]()").strip()
    spelt = SYMBOLS.get(text, SYMBOLS.get(text.lower(), re.sub(r"[^a-z0-9]", "", text.lower())))
    return UNITS.get(spelt)
