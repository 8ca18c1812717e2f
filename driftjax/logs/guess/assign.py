"""Assign columns to channels: by name and unit first, then repeatedly by relations to the channels assigned so far."""

from typing import NamedTuple

import numpy as np

from driftjax.logs.geodesy import east_north
from driftjax.logs.guess.log_columns import Column, LogColumns
from driftjax.logs.guess.names import DIMENSIONS, Meaning, meaning
from driftjax.logs.guess.relations import (
    FACTORS,
    LENGTHS,
    RelationFit,
    Signal,
    consistency,
    fast,
    fit_relation,
    kinematic_relations,
    size_fits,
    smoothed,
    turned,
)
from driftjax.logs.guess.sources import heading_beside, source_of, turned_axes
from driftjax.logs.guess.units import best_factors
from driftjax.logs.unit_words import DEG, UNITS

ROUNDS = 4  # at most
NAMED, FOLLOWS, ONLY_NAMED = 0.4, 0.6, 0.7  # weights of name and consistency; of the name where nothing else speaks
LEAST = 0.3  # least score of an assigned channel
# channels that consistency alone does not assign
BY_NAME = ("Fxr", "latitude", "longitude", "s", "e", "wfl", "wfr", "wrl", "wrr")
BY_NAME_LEAST = 0.5
ANGLES = {"angle": 3.5, "rate": 12.0}  # above it radians are implausible [rad], [rad/s]
ALIKE = 0.7  # correlation from which a sign is clear
UNSIGNED = ("x", "y", "V", "vx")  # that are never given another sign
SIGNED = ("vy", "beta", "r", "psi", "ay", "delta")


class ChannelAssignment(NamedTuple):
    """Column assigned to a channel."""

    role: str
    column: Column
    signal: Signal
    """Smoothed [unit of the column]."""
    factor: float
    score: float
    fit: RelationFit | None
    """The relation that it follows best."""
    rival: str | None
    """Another column that fits about as well."""


class _Known(NamedTuple):
    """Column with the meaning of its name and its smoothed values."""

    column: Column
    meaning: Meaning
    signal: Signal


def assign_channels(log: LogColumns) -> dict[str, ChannelAssignment]:
    """Assign the columns of a log to channels."""
    known = [_Known(one, meaning(one.name, one.unit), smoothed(one.y, log.dt)) for one in log.columns]
    assigned = _assigned(known, {}, log.dt)
    for _ in range(ROUNDS):
        last, assigned = assigned, _assigned(known, assigned, log.dt)
        if {role: (one.column.name, one.factor) for role, one in last.items()} == {
            role: (one.column.name, one.factor) for role, one in assigned.items()
        }:
            break
    return _turned(_one_pose(assigned, known, log.dt), log.dt)


def channel_signals(assigned: dict[str, ChannelAssignment], dt: float) -> dict[str, Signal]:
    """Return the channels as `untransformed_signals`, the heading rotated to the direction of travel."""
    return turned(untransformed_signals(assigned, dt))


def untransformed_signals(assigned: dict[str, ChannelAssignment], dt: float) -> dict[str, Signal]:
    """Return the channels with values, in SI units; x and y from latitude and longitude where these are there."""
    signals = {role: one.signal.scaled(one.factor) for role, one in assigned.items() if one.signal.holds_values()}
    latitude, longitude = signals.pop("latitude", None), signals.pop("longitude", None)
    if latitude is not None and longitude is not None and not {"x", "y"} <= set(signals):
        there = np.flatnonzero(np.isfinite(latitude.y + longitude.y))
        if there.size:
            north, east = np.degrees(latitude.y), np.degrees(longitude.y)
            metres = east_north(north, east, (float(north[there[0]]), float(east[there[0]])))
            signals |= {role: smoothed(one, dt) for role, one in zip("xy", metres, strict=True)}
    return signals


def _one_pose(assigned: dict[str, ChannelAssignment], known: list[_Known], dt: float) -> dict[str, ChannelAssignment]:
    """Return the channels with the heading of the source of the position, unless another one is clearly better."""
    if "psi" not in assigned or "x" not in assigned:
        return assigned
    best, x = assigned["psi"], assigned["x"]
    v = channel_signals({role: one for role, one in assigned.items() if role != "psi"}, dt)
    mask, rules = fast(v, len(best.signal.y)), kinematic_relations("psi", v, dt)
    scored = {one.column.name: (one, *_scored("psi", one, [fit_relation(rule, one.signal, mask) for rule in rules]))
              for one in known if source_of(one.column.name) == source_of(x.column.name)}  # fmt: skip
    name = heading_beside(x.column.name, [(name, one[1]) for name, one in scored.items()], best.score)
    if name is None:
        return assigned
    column, score, fit, factor = scored[name]
    return assigned | {"psi": ChannelAssignment("psi", column.column, column.signal, factor, score, fit, None)}


def _turned(assigned: dict[str, ChannelAssignment], dt: float) -> dict[str, ChannelAssignment]:
    """Return the channels with ax and ay from the axes that follow them, if the sensor is mounted a quarter turn."""
    if not {"ax", "ay"} <= set(assigned):
        return assigned
    ahead, left = assigned["ax"], assigned["ay"]
    axes_fits = turned_axes(ahead.signal, left.signal, channel_signals(assigned, dt), dt)
    if axes_fits is None:
        return assigned
    units = FACTORS["acceleration"]
    for role, one, follows in zip(("ax", "ay"), (left, ahead), axes_fits, strict=True):
        unit = max(units, key=lambda factor: size_fits(axes_fits[1].factor, (factor,)))  # one sensor, one unit
        factor = float(np.copysign(unit, follows.factor))
        assigned = assigned | {
            role: ChannelAssignment(role, one.column, one.signal, factor, abs(follows.correlation), follows, None)
        }
    return assigned


def _assigned(known: list[_Known], assigned: dict[str, ChannelAssignment], dt: float) -> dict[str, ChannelAssignment]:
    """Return the best assignment, one column to a channel, by scores that follow from the last one."""
    from scipy.optimize import linear_sum_assignment  # takes a second to load, with every command and worker

    v = channel_signals(assigned, dt)
    roles = list(DIMENSIONS)[1:]  # all but the time
    mask = fast(v, len(known[0].signal.y)) if known else np.ones(0, bool)
    rules = {role: kinematic_relations(role, v, dt) for role in roles}
    table = [[_scored(role, one, [fit_relation(rule, one.signal, mask) for rule in rules[role]]) for one in known]
             for role in roles]  # fmt: skip
    scores = np.array([[one[0] for one in row] for row in table]).reshape(len(roles), len(known))
    padded = np.hstack([scores, np.full((len(roles), len(roles)), LEAST)])  # a channel may stay empty
    new = {}
    for i, j in zip(*linear_sum_assignment(padded, maximize=True), strict=True):
        if j < len(known) and scores[i, j] > LEAST:
            score, fit, factor = table[i][j]
            taken = scores[i].copy()
            taken[j] = 0.0
            rival = known[int(np.argmax(taken))].column.name if taken.max(initial=0) > 0.95 * score else None
            new[roles[i]] = ChannelAssignment(roles[i], known[j].column, known[j].signal, factor, score, fit, rival)
    return _signed(resolve_units(new, {one.column.name: one.meaning for one in known}, dt), dt)


def _scored(role: str, one: _Known, fits: list[RelationFit | None]) -> tuple[float, RelationFit | None, float]:
    """Return score, best relation and factor of a column as channel `role`."""
    name_score, allowed = one.meaning.name_score[role], _allowed(role, one.meaning)
    if not name_score or (role in BY_NAME and name_score < BY_NAME_LEAST):
        return 0.0, None, 1.0
    there = [fit for fit in fits if fit is not None]
    if not there:
        return ONLY_NAMED * name_score, None, _plain_factor(role, one, allowed)
    best = max(there, key=lambda fit: consistency(fit, allowed))
    agreed = consistency(best, allowed)
    score = NAMED * name_score + FOLLOWS * agreed
    if agreed == 0.0:
        return score, None, _plain_factor(role, one, allowed)
    size = _nearest(role, best, allowed, one)
    return score, best, size if role in UNSIGNED else float(np.copysign(size, best.factor))


def _allowed(role: str, meant: Meaning) -> tuple[float, ...]:
    return (meant.unit.factor,) if meant.unit else FACTORS.get(DIMENSIONS[role], (1.0,))


def _nearest(role: str, fit: RelationFit, allowed: tuple[float, ...], one: _Known) -> float:
    """Return the factor of the unit that is nearest to the factor of the fitted relation."""
    if role == "delta" and len(allowed) > 1:  # a wheelbase says degrees or radians
        fits = [factor for factor in allowed if LENGTHS[0] <= factor / abs(fit.factor) <= LENGTHS[1]]
        return fits[0] if fits else _plain_factor(role, one, allowed)
    if fit.relation.scale_free or size_fits(fit.factor, allowed) < 0.5:
        return _plain_factor(role, one, allowed)
    return min(allowed, key=lambda factor: abs(np.log(abs(fit.factor) / factor)))


def _plain_factor(role: str, one: _Known, allowed: tuple[float, ...]) -> float:
    """Return the factor where no relation determines it: degrees if the values are implausible as radians."""
    if role in ("latitude", "longitude"):
        return DEG if not one.meaning.unit else allowed[0]
    most = ANGLES.get(DIMENSIONS[role])
    tells = most is not None and role != "psi" and one.signal.holds_values()
    large = tells and np.nanpercentile(np.abs(one.signal.y), 99) > most
    return DEG if large and len(allowed) > 1 else next(iter(allowed))


def resolve_units(
    assigned: dict[str, ChannelAssignment], meanings: dict[str, Meaning], dt: float
) -> dict[str, ChannelAssignment]:
    """Return the channels with the units that agree best where none is stated."""
    signals = {role: one.signal for role, one in assigned.items()
               if role not in ("latitude", "longitude") and one.signal.holds_values()}  # fmt: skip
    v = channel_signals(assigned, dt)
    signals |= {role: v[role] for role in ("x", "y") if role in v and role not in signals}
    own = {
        role: meanings[assigned[role].column.name] if role in assigned else Meaning(UNITS["m"], {}) for role in signals
    }
    factors = {role: assigned[role].factor if role in assigned else 1.0 for role in signals}
    sizes = best_factors(signals, own, factors, dt)
    return {role: one._replace(factor=float(np.copysign(sizes.get(role, abs(one.factor)), one.factor)))
            for role, one in assigned.items()}  # fmt: skip


def _signed(assigned: dict[str, ChannelAssignment], dt: float) -> dict[str, ChannelAssignment]:
    """Return the channels with the sign of the yaw rate that the position, or most of the others, have."""
    v = channel_signals({role: one._replace(factor=abs(one.factor)) for role, one in assigned.items()}, dt)
    if "r" not in v:
        return assigned
    mask = fast(v, len(v["r"].y))
    cosines = {rule.name: _cosine(v["r"].y[mask], rule.predicted[mask]) for rule in kinematic_relations("r", v, dt)}
    clear = {name: cosine for name, cosine in cosines.items() if abs(cosine) > ALIKE}
    votes = [clear["rate of the course"]] if "rate of the course" in clear else list(clear.values())
    against = sum(vote < 0 for vote in votes)  # a position is seldom mirrored, a yaw rate often
    sign = -1.0 if against > len(votes) / 2 and (against > 1 or "rate of the course" in clear) else 1.0
    assigned = assigned | {"r": assigned["r"]._replace(factor=sign * abs(assigned["r"].factor))}
    if (turns := clear.get("rate of the heading")) is not None:
        heading = assigned["psi"]
        assigned["psi"] = heading._replace(factor=float(np.copysign(heading.factor, turns * sign)))
    return assigned


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of two quantities about zero, defined on a steady circle too; 0 without data."""
    both = np.isfinite(a) & np.isfinite(b)
    size = float(np.linalg.norm(a[both]) * np.linalg.norm(b[both]))
    return float(a[both] @ b[both]) / size if size > 0 else 0.0
