"""Place columns as channels: by name and unit first, then again and again by what the channels placed say."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from driftjax.logs.geodesy import east_north
from driftjax.logs.guess.material import Column, Material
from driftjax.logs.guess.names import DEG, DIMENSIONS, UNITS, Meaning, meaning
from driftjax.logs.guess.relations import (
    FACTORS,
    LENGTHS,
    Fit,
    Signal,
    consistency,
    fast,
    fit,
    relations,
    size_fits,
    smoothed,
    turned,
)
from driftjax.logs.guess.sources import heading_beside, source_of, turned_axes
from driftjax.logs.guess.units import best_factors

ROUNDS = 4  # at most
NAMED, FOLLOWS, ONLY_NAMED = 0.4, 0.6, 0.7  # weights of name and consistency; of the name where nothing else speaks
LEAST = 0.3  # score of a channel that is placed
# what consistency alone does not place
BY_NAME = ("Fxr", "latitude", "longitude", "s", "e", "wfl", "wfr", "wrl", "wrr")
BY_NAME_LEAST = 0.5
ANGLES = {"angle": 3.5, "rate": 12.0}  # above it radians are implausible [rad], [rad/s]
ALIKE = 0.7  # correlation from which a sign is clear
UNSIGNED = ("x", "y", "V", "vx")  # that are never given another sign
SIGNED = ("vy", "beta", "r", "psi", "ay", "delta")


class Placed(NamedTuple):
    """A column as a channel."""

    role: str
    column: Column
    signal: Signal
    """Smoothed [unit of the column]."""
    factor: float
    score: float
    fit: Fit | None
    """The relation that it follows best."""
    rival: str | None
    """Another column that fits about as well."""


class _Known(NamedTuple):
    """A column with what its name says, and its smoothed values."""

    column: Column
    said: Meaning
    signal: Signal


def place(material: Material) -> dict[str, Placed]:
    """Return the columns placed as channels."""
    known = [_Known(one, meaning(one.name, one.unit), smoothed(one.y, material.dt)) for one in material.columns]
    placed = _assigned(known, {}, material.dt)
    for _ in range(ROUNDS):
        last, placed = placed, _assigned(known, placed, material.dt)
        if {role: (one.column.name, one.factor) for role, one in last.items()} == {
            role: (one.column.name, one.factor) for role, one in placed.items()
        }:
            break
    return _turned(_one_pose(placed, known, material.dt), material.dt)


def values(placed: dict[str, Placed], dt: float) -> dict[str, Signal]:
    """Return the placed channels as `plain_values`, the heading turned so that it follows the direction of travel."""
    return turned(plain_values(placed, dt))


def plain_values(placed: dict[str, Placed], dt: float) -> dict[str, Signal]:
    """Return the placed channels in SI units; x and y from latitude and longitude where these are there."""
    found = {role: one.signal.scaled(one.factor) for role, one in placed.items()}
    latitude, longitude = found.pop("latitude", None), found.pop("longitude", None)
    if latitude is not None and longitude is not None and not {"x", "y"} <= set(found):
        there = np.flatnonzero(np.isfinite(latitude.y + longitude.y))
        if there.size:
            north, east = np.degrees(latitude.y), np.degrees(longitude.y)
            metres = east_north(north, east, (float(north[there[0]]), float(east[there[0]])))
            found |= {role: smoothed(one, dt) for role, one in zip("xy", metres, strict=True)}
    return found


def _one_pose(placed: dict[str, Placed], known: list[_Known], dt: float) -> dict[str, Placed]:
    """Return the channels with the heading that comes with the position, where another one is hardly better."""
    if "psi" not in placed or "x" not in placed:
        return placed
    best, x = placed["psi"], placed["x"]
    v = values({role: one for role, one in placed.items() if role != "psi"}, dt)
    mask, rules = fast(v, len(best.signal.y)), relations("psi", v, dt)
    scored = {one.column.name: (one, *_scored("psi", one, [fit(rule, one.signal, mask) for rule in rules]))
              for one in known if source_of(one.column.name) == source_of(x.column.name)}  # fmt: skip
    name = heading_beside(x.column.name, [(name, one[1]) for name, one in scored.items()], best.score)
    if name is None:
        return placed
    column, score, found, factor = scored[name]
    return placed | {"psi": Placed("psi", column.column, column.signal, factor, score, found, None)}


def _turned(placed: dict[str, Placed], dt: float) -> dict[str, Placed]:
    """Return the channels with ax and ay from the axes that follow them, if the sensor is mounted a quarter turn."""
    if not {"ax", "ay"} <= set(placed):
        return placed
    ahead, left = placed["ax"], placed["ay"]
    found = turned_axes(ahead.signal, left.signal, values(placed, dt), dt)
    if found is None:
        return placed
    units = FACTORS["acceleration"]
    for role, one, follows in zip(("ax", "ay"), (left, ahead), found, strict=True):
        unit = max(units, key=lambda factor: size_fits(found[1].factor, (factor,)))  # one sensor, one unit
        factor = float(np.copysign(unit, follows.factor))
        placed = placed | {role: Placed(role, one.column, one.signal, factor, abs(follows.correlation), follows, None)}
    return placed


def _assigned(known: list[_Known], placed: dict[str, Placed], dt: float) -> dict[str, Placed]:
    """Return the best assignment, one column to a channel, by scores that follow from the last one."""
    v = values(placed, dt)
    roles = list(DIMENSIONS)[1:]  # all but the time
    mask = fast(v, len(known[0].signal.y)) if known else np.ones(0, bool)
    rules = {role: relations(role, v, dt) for role in roles}
    table = [[_scored(role, one, [fit(rule, one.signal, mask) for rule in rules[role]]) for one in known]
             for role in roles]  # fmt: skip
    scores = np.array([[one[0] for one in row] for row in table]).reshape(len(roles), len(known))
    padded = np.hstack([scores, np.full((len(roles), len(roles)), LEAST)])  # a channel may stay empty
    new = {}
    for i, j in zip(*linear_sum_assignment(padded, maximize=True), strict=True):
        if j < len(known) and scores[i, j] > LEAST:
            score, found, factor = table[i][j]
            taken = scores[i].copy()
            taken[j] = 0.0
            rival = known[int(np.argmax(taken))].column.name if taken.max(initial=0) > 0.95 * score else None
            new[roles[i]] = Placed(roles[i], known[j].column, known[j].signal, factor, score, found, rival)
    return _signed(resolve_units(new, {one.column.name: one.said for one in known}, dt), dt)


def _scored(role: str, one: _Known, fits: list[Fit | None]) -> tuple[float, Fit | None, float]:
    """Return score, best relation and factor of a column as channel `role`."""
    name_score, allowed = one.said.name_score[role], _allowed(role, one.said)
    if not name_score or (role in BY_NAME and name_score < BY_NAME_LEAST):
        return 0.0, None, 1.0
    there = [found for found in fits if found is not None]
    if not there:
        return ONLY_NAMED * name_score, None, _plain_factor(role, one, allowed)
    best = max(there, key=lambda found: consistency(found, allowed))
    agreed = consistency(best, allowed)
    score = NAMED * name_score + FOLLOWS * agreed
    if agreed == 0.0:
        return score, None, _plain_factor(role, one, allowed)
    size = _nearest(role, best, allowed, one)
    return score, best, size if role in UNSIGNED else float(np.copysign(size, best.factor))


def _allowed(role: str, said: Meaning) -> tuple[float, ...]:
    return (said.unit.factor,) if said.unit else FACTORS.get(DIMENSIONS[role], (1.0,))


def _nearest(role: str, found: Fit, allowed: tuple[float, ...], one: _Known) -> float:
    """Return the unit's factor that fits best what a column is to be multiplied by."""
    if role == "delta" and len(allowed) > 1:  # a wheelbase says degrees or radians
        fits = [factor for factor in allowed if LENGTHS[0] <= factor / abs(found.factor) <= LENGTHS[1]]
        return fits[0] if fits else _plain_factor(role, one, allowed)
    if found.relation.scale_free or size_fits(found.factor, allowed) < 0.5:
        return _plain_factor(role, one, allowed)
    return min(allowed, key=lambda factor: abs(np.log(abs(found.factor) / factor)))


def _plain_factor(role: str, one: _Known, allowed: tuple[float, ...]) -> float:
    """Return the factor where no relation tells it: degrees if radians would be implausible."""
    if role in ("latitude", "longitude"):
        return DEG if not one.said.unit else allowed[0]
    most = ANGLES.get(DIMENSIONS[role])
    large = most is not None and np.nanpercentile(np.abs(one.signal.y), 99) > most and role != "psi"
    return DEG if large and len(allowed) > 1 else next(iter(allowed))


def resolve_units(placed: dict[str, Placed], said: dict[str, Meaning], dt: float) -> dict[str, Placed]:
    """Return the channels with the units that agree best where none is stated."""
    signals = {role: one.signal for role, one in placed.items() if role not in ("latitude", "longitude")}
    v = values(placed, dt)
    signals |= {role: v[role] for role in ("x", "y") if role in v and role not in signals}
    meanings = {role: said[placed[role].column.name] if role in placed else Meaning(UNITS["m"], {}) for role in signals}
    factors = {role: placed[role].factor if role in placed else 1.0 for role in signals}
    sizes = best_factors(signals, meanings, factors, dt)
    return {role: one._replace(factor=float(np.copysign(sizes.get(role, abs(one.factor)), one.factor)))
            for role, one in placed.items()}  # fmt: skip


def _signed(placed: dict[str, Placed], dt: float) -> dict[str, Placed]:
    """Return the channels with the sign of the yaw rate that the position, or most of the others, have."""
    if "r" not in placed:
        return placed
    v = values({role: one._replace(factor=abs(one.factor)) for role, one in placed.items()}, dt)
    mask = fast(v, len(v["r"].y))
    found = {rule.name: _cosine(v["r"].y[mask], rule.predicted[mask]) for rule in relations("r", v, dt)}
    clear = {name: cosine for name, cosine in found.items() if abs(cosine) > ALIKE}
    votes = [clear["rate of the course"]] if "rate of the course" in clear else list(clear.values())
    against = sum(vote < 0 for vote in votes)  # a position is seldom mirrored, a yaw rate often
    sign = -1.0 if against > len(votes) / 2 and (against > 1 or "rate of the course" in clear) else 1.0
    placed = placed | {"r": placed["r"]._replace(factor=sign * abs(placed["r"].factor))}
    if (turns := clear.get("rate of the heading")) is not None:
        heading = placed["psi"]
        placed["psi"] = heading._replace(factor=float(np.copysign(heading.factor, turns * sign)))
    return placed


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of two quantities about zero, which a steady circle has too; 0 where nothing is known."""
    both = np.isfinite(a) & np.isfinite(b)
    size = float(np.linalg.norm(a[both]) * np.linalg.norm(b[both]))
    return float(a[both] @ b[both]) / size if size > 0 else 0.0
