"""Predict a channel from the others by kinematic relations, and test how well a column follows it."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from driftjax.logs.agreement import MAX_LATERAL_ACCELERATION, MIN_SAMPLES, SLOW, smooth_with_rate
from driftjax.logs.unit_words import DEG, STANDARD_GRAVITY

EXACT, NEAR, LOOSE = 1.0, 0.8, 0.6  # weight of a relation: of rigid bodies, without sideslip, of cars as a rule
EVERY = 4  # sample that the size of the values is taken from
WEAK = 0.6  # correlation that says nothing
ALIKE = (0.8, 1.25)  # ratio to the factor of a unit
NOT_UNLIKE = (0.6, 1.6)
FACTORS = {"speed": (1.0, 1 / 3.6, 0.44704, 1852 / 3600), "rate": (1.0, DEG), "angle": (1.0, DEG),
           "length": (1.0, 1e3, 1e-2, 1e-3), "acceleration": (1.0, STANDARD_GRAVITY)}  # fmt: skip
LENGTHS = (0.05, 5.5)  # wheelbases of cars [m]

Values = Mapping[str, "Signal"]


class Signal(NamedTuple):
    """Smoothed values and rates (n,), NaN where nothing was measured."""

    y: np.ndarray
    rate: np.ndarray

    def holds_values(self) -> bool:
        """Return whether anything was measured, often enough to smooth."""
        return bool(np.isfinite(self.y).any())

    def scaled(self, factor: float, offset: float = 0.0) -> "Signal":
        """Return the signal in another unit."""
        return Signal(factor * self.y + offset, factor * self.rate)


def smoothed(y: np.ndarray, dt: float) -> Signal:
    """Return values and rates by parabolas over a quarter of a second."""
    return Signal(*smooth_with_rate(y, dt))


class Relation(NamedTuple):
    """A quantity that the values of a channel, or their rate, should equal."""

    name: str
    strength: float
    predicted: np.ndarray
    of_rate: bool = False
    scale_free: bool = False
    """Whether only the course of the values says something, not their size."""


class RelationFit(NamedTuple):
    """Fit of a column to a relation."""

    relation: Relation
    correlation: float
    factor: float
    """Predicted over measured deviation, with the sign of the correlation."""


def course(v: Values) -> tuple[np.ndarray, np.ndarray] | None:
    """Return direction of travel [rad], without jumps, and its rate; None without a position."""
    if "x" not in v or "y" not in v:
        return None
    ahead, left = v["x"].rate, v["y"].rate
    speed = np.hypot(ahead, left)
    moving = speed > SLOW * np.nanmax(np.append(speed, 0.0))
    angle = np.where(moving, np.arctan2(left, ahead), np.nan)
    there = np.isfinite(angle)
    angle[there] = np.unwrap(angle[there])
    rate = np.gradient(angle) if len(angle) > 1 else angle
    return angle, np.where(np.abs(rate) < 1.0, rate, np.nan)  # per sample; larger ones are jumps between runs


def fast(v: Values, n: int) -> np.ndarray:
    """Return where the car is not slow (n,); everywhere without a speed."""
    speed = v["V"].y if "V" in v else np.abs(v["vx"].y) if "vx" in v else None
    if speed is None or not np.isfinite(speed).any():
        return np.ones(n, bool)
    return np.nan_to_num(speed) > SLOW * np.nanpercentile(speed, 99)


def heading_offset(v: Values) -> float | None:
    """Return the mean of course less heading [rad]; None where it varies or cannot be computed."""
    if "psi" not in v or (way := course(v)) is None:
        return None
    turn = np.exp(1j * (way[0] - v["psi"].y))[fast(v, len(way[0]))]
    mean = np.nanmean(turn) if np.isfinite(turn).any() else 0.0
    return float(np.angle(mean)) if abs(mean) > 0.9 else None


def turned(v: Values) -> dict[str, Signal]:
    """Return the channels with the heading turned so that it follows the direction of travel."""
    turn = heading_offset(v)
    return dict(v) if turn is None else dict(v) | {"psi": v["psi"].scaled(1.0, turn)}


def kinematic_relations(role: str, v: Values, dt: float) -> list[Relation]:
    """Return the kinematic relations that predict channel `role` from the channels `v` (SI)."""
    rules = {"V": _speed, "vx": _ahead, "vy": _left, "beta": _sideslip, "r": _yaw_rate, "psi": _heading, "x": _east,
             "y": _north, "ax": _along, "ay": _across, "delta": _steering, "Fxr": _force}.get(role)  # fmt: skip
    others = {name: one for name, one in v.items() if name != role}
    return rules(others, dt) if rules else []


def _largest(values: np.ndarray) -> float:
    """Return the largest value, NaN where there is none."""
    return float(np.nanmax(values)) if np.isfinite(values).any() else np.nan


def _has(v: Values, *names: str) -> bool:
    return all(name in v for name in names)


def _any_speed(v: Values) -> np.ndarray | None:
    if "V" in v:
        return v["V"].y
    if "vx" in v:
        return np.hypot(v["vx"].y, v["vy"].y) if "vy" in v else np.abs(v["vx"].y)
    return np.hypot(v["x"].rate, v["y"].rate) if _has(v, "x", "y") else None


def _speed_rate(v: Values, dt: float) -> np.ndarray | None:
    if "V" in v:
        return v["V"].rate
    if "vx" in v:
        return v["vx"].rate
    speed = _any_speed(v)
    return None if speed is None else np.gradient(speed, dt)


def _speed(v: Values, dt: float) -> list[Relation]:
    relations = []
    if _has(v, "x", "y"):
        relations.append(Relation("speed of the position", EXACT, np.hypot(v["x"].rate, v["y"].rate)))
    if _has(v, "vx"):
        relations.append(Relation("vx", NEAR, np.hypot(v["vx"].y, v["vy"].y if "vy" in v else 0.0)))
    return [*relations, *_speed_otherwise(v)]


def _speed_otherwise(v: Values) -> list[Relation]:
    relations = [Relation("rate of s", LOOSE, v["s"].rate)] if _has(v, "s") else []
    if _has(v, "r", "ay"):
        turning = np.where(np.abs(v["r"].y) > 0.2 * np.nanstd(v["r"].y), v["r"].y, np.nan)
        relations.append(Relation("ay / r", LOOSE, v["ay"].y / turning))
    return relations


def _ahead(v: Values, dt: float) -> list[Relation]:
    relations = []
    if _has(v, "x", "y", "psi"):
        along = v["x"].rate * np.cos(v["psi"].y) + v["y"].rate * np.sin(v["psi"].y)
        relations.append(Relation("velocity along the heading", EXACT, along))
    if _has(v, "V"):
        relations.append(Relation("V cos(beta)", NEAR, v["V"].y * (np.cos(v["beta"].y) if "beta" in v else 1.0)))
    if _has(v, "x", "y"):
        relations.append(Relation("speed of the position", NEAR, np.hypot(v["x"].rate, v["y"].rate)))
    return [*relations, *_speed_otherwise(v)]


def _left(v: Values, dt: float) -> list[Relation]:
    relations = []
    if _has(v, "x", "y", "psi"):
        across = v["y"].rate * np.cos(v["psi"].y) - v["x"].rate * np.sin(v["psi"].y)
        relations.append(Relation("velocity across the heading", EXACT, across))
    if _has(v, "V", "beta"):
        relations.append(Relation("V sin(beta)", EXACT, v["V"].y * np.sin(v["beta"].y)))
    if _has(v, "r", "ay") and (speed := _any_speed(v)) is not None:
        relations.append(Relation("ay - V r", LOOSE, v["ay"].y - speed * v["r"].y, of_rate=True))
    return relations


def _sideslip(v: Values, dt: float) -> list[Relation]:
    relations = []
    if _has(v, "psi") and (way := course(v)) is not None:
        relations.append(Relation("course less heading", EXACT, np.angle(np.exp(1j * (way[0] - v["psi"].y)))))
    if _has(v, "vx", "vy"):
        relations.append(Relation("direction of vx, vy", EXACT, np.arctan2(v["vy"].y, v["vx"].y)))
    if _has(v, "r", "ay") and (speed := _any_speed(v)) is not None:
        fast = np.where(speed > SLOW * _largest(speed), speed, np.nan)
        relations.append(Relation("ay / V - r", LOOSE, v["ay"].y / fast - v["r"].y, of_rate=True))
    return relations


def _yaw_rate(v: Values, dt: float) -> list[Relation]:
    relations = []
    if _has(v, "psi"):
        relations.append(Relation("rate of the heading", EXACT, v["psi"].rate))
    if (way := course(v)) is not None:
        relations.append(Relation("rate of the course", NEAR, way[1] / dt))
    if _has(v, "ay") and (speed := _any_speed(v)) is not None:
        fast = np.where(speed > SLOW * _largest(speed), speed, np.nan)
        relations.append(Relation("ay / V", NEAR, v["ay"].y / fast))
    return relations


def _heading(v: Values, dt: float) -> list[Relation]:
    relations = [Relation("r", EXACT, v["r"].y, of_rate=True)] if _has(v, "r") else []
    if (way := course(v)) is not None:
        relations.append(Relation("rate of the course", NEAR, way[1] / dt, of_rate=True))
    return relations


def _east(v: Values, dt: float) -> list[Relation]:
    return _position(v, np.cos, np.sin, -1.0)


def _north(v: Values, dt: float) -> list[Relation]:
    return _position(v, np.sin, np.cos, 1.0)


def _position(v: Values, along: Callable, across: Callable, sign: float) -> list[Relation]:
    if not _has(v, "psi"):
        return []
    if _has(v, "vx"):
        sideways = sign * v["vy"].y * across(v["psi"].y) if "vy" in v else 0.0
        return [Relation("velocity along the heading", EXACT, v["vx"].y * along(v["psi"].y) + sideways, of_rate=True)]
    if _has(v, "V"):
        way = v["psi"].y + (v["beta"].y if "beta" in v else 0.0)
        return [Relation("V along the heading", NEAR, v["V"].y * along(way), of_rate=True)]
    return []


def _along(v: Values, dt: float) -> list[Relation]:
    rate = _speed_rate(v, dt)
    if rate is None:
        return []
    turned = v["r"].y * v["vy"].y if _has(v, "r", "vy") else 0.0
    return [Relation("rate of the speed", EXACT if _has(v, "vx", "vy", "r") else NEAR, rate - turned)]


def _across(v: Values, dt: float) -> list[Relation]:
    speed = _any_speed(v)
    if speed is None or "r" not in v:
        return []
    sliding = v["vy"].rate if "vy" in v else speed * v["beta"].rate if "beta" in v else None
    relations = [Relation("V r", NEAR, speed * v["r"].y)]
    return relations if sliding is None else [Relation("V (beta' + r)", EXACT, speed * v["r"].y + sliding), *relations]


def _steering(v: Values, dt: float) -> list[Relation]:
    speed = _any_speed(v)
    if speed is None or "r" not in v:
        return []
    fast = np.where(speed > 2 * SLOW * _largest(speed), speed, np.nan)
    gentle = np.abs(speed * v["r"].y) < 1.5 * MAX_LATERAL_ACCELERATION
    return [Relation("r / V", LOOSE, np.where(gentle, v["r"].y / fast, np.nan), scale_free=True)]


def _force(v: Values, dt: float) -> list[Relation]:
    rate = v["ax"].y if "ax" in v else _speed_rate(v, dt)
    return [] if rate is None else [Relation("ax", LOOSE, rate, scale_free=True)]


def fit_relation(relation: Relation, signal: Signal, fast: np.ndarray) -> RelationFit | None:
    """Fit a column to a relation where the car is `fast` (n,); None with too little variation."""
    y = signal.rate if relation.of_rate else signal.y
    both = fast & np.isfinite(y) & np.isfinite(relation.predicted)
    if both.sum() < MIN_SAMPLES:
        return None
    a, b = y[both], relation.predicted[both]
    if not (np.std(a) > 0 and np.std(b) > 0):
        return None
    correlation = float(np.corrcoef(a, b)[0, 1])
    spread = lambda values: float(np.ptp(np.percentile(values[::EVERY], [2, 98])))  # not of single jumps
    if not (spread(a) > 0 and spread(b) > 0):
        return None
    return RelationFit(relation, correlation, float(np.copysign(spread(b) / spread(a), correlation)))


def size_fits(factor: float, allowed: tuple[float, ...]) -> float:
    """Score the size of `factor` against those allowed, from 0.1 to 1."""
    ratios = [abs(factor) / one for one in allowed]
    inside = lambda low, high: any(low <= ratio <= high for ratio in ratios)
    return 1.0 if inside(*ALIKE) else 0.6 if inside(*NOT_UNLIKE) else 0.1


def consistency(fit: RelationFit, allowed: tuple[float, ...]) -> float:
    """Score from 0 to 1 whether a column is the channel of a relation, in units with the factors `allowed`."""
    follows = max(abs(fit.correlation) - WEAK, 0.0) / (1 - WEAK)
    return fit.relation.strength * follows * (1.0 if fit.relation.scale_free else size_fits(fit.factor, allowed))
