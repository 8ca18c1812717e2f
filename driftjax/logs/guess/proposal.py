"""Propose the column map of a log, with a certainty per channel and open questions."""

import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from driftjax.core import BadInput, write_text
from driftjax.logs.agreement import SLOW, time_shift
from driftjax.logs.columns import (
    CHANNELS,
    COMMANDS,
    OPTIONAL,
    Channel,
    ColumnMap,
    Condition,
    Position,
    dispensable,
    first_missing,
)
from driftjax.logs.guess.assign import (
    LEAST,
    SIGNED,
    ChannelAssignment,
    assign_channels,
    channel_signals,
    untransformed_signals,
)
from driftjax.logs.guess.log_columns import LogColumns, read_log_columns
from driftjax.logs.guess.names import UNKNOWN, meaning, words_of
from driftjax.logs.guess.relations import (
    LENGTHS,
    Signal,
    course,
    fast,
    fit_relation,
    heading_offset,
    kinematic_relations,
)
from driftjax.logs.sampling import proposed_rate
from driftjax.logs.unit_words import DEG

PEDALS = {"throttle", "gas", "accelerator", "pedal", "brake", "motor", "torque", "duty", "current", "power"}
UNSURE = 0.8  # of the certainty that is left where a sign is only the file's, or another column fits as well
RIGHT_ANGLE, NEAR_ANGLE = np.pi / 2, 0.1  # offsets of a heading that are meant to be whole right angles [rad]
REFUTED = 0.25  # correlation below which a column is not what its name says
NEAR_ZERO = 0.1  # m/s, of a speed ahead; less is noise at a standstill
ORDER = (*CHANNELS[:3], "vx", "vy", *CHANNELS[3:], "x", "y", "psi", "ax", "ay", "s", "e", "wfl", "wfr", "wrl", "wrr")


@dataclass(frozen=True)
class Guessed:
    """One channel of a proposed column map."""

    channel: str
    """Channel of the log format; `latitude` and `longitude` stand for x and y."""
    column: str
    """Column of the file."""
    factor: float
    """Channel unit per unit of the column."""
    offset: float
    """Added after the factor [channel unit]."""
    certainty: float
    """From 0 to 1; a score, no probability."""
    reason: str
    """Evidence for it, in words."""
    delay: float | None
    """Delay of the column after its prediction from other channels [s]; None where it cannot be estimated."""


@dataclass(frozen=True)
class Guess:
    """A proposed column map; `str` is the table that the command line prints, `yaml` the map."""

    path: Path
    channels: tuple[Guessed, ...]
    run: str | None
    """Column that names runs."""
    stamps: str
    open: tuple[str, ...] = field(default=())
    """Sentences about what could not be assigned or confirmed."""
    where: tuple[Condition, ...] = ()
    """Rows that count: those driven forwards, where some are not."""
    rate: float | None = None
    """Even rate to resample to [Hz], where the time steps are uneven."""

    def lacks(self) -> str | None:
        """Return the first channel which a log must have and no column was recognised as; None if all are there."""
        return first_missing(one.channel for one in self.channels)

    def column_map(self) -> ColumnMap:
        """Return the map; raises `BadInput` that names a needed channel which no column was recognised as."""
        if (lacks := self.lacks()) is not None:
            raise BadInput(f"{self.path}: no column was recognised as '{lacks}'; write a column map that names it.")
        earth = {one.channel: one for one in self.channels if one.channel in ("latitude", "longitude")}
        channels = tuple(Channel(one.channel, one.column, one.factor, one.offset)
                         for one in self.channels if one.channel not in earth)  # fmt: skip
        position = None
        if len(earth) == 2:
            latitude = earth["latitude"]
            position = Position(latitude.column, earth["longitude"].column, latitude.factor / DEG)
        run = () if self.run is None else (self.run,)
        stamps: Any = self.stamps
        return ColumnMap(channels, run, self.where, position_from=position, rate=self.rate, stamps=stamps)

    def content(self) -> dict[str, Any]:
        """Return the guess as plain values, for JSON."""
        return asdict(self) | {"path": str(self.path)}

    def yaml(self) -> str:
        """Return the column map as YAML, with open questions as comments."""
        lines = [f"# Proposed for {self.path.name}; look it over before you use it.", "columns:"]
        earth = {one.channel: one for one in self.channels if one.channel in ("latitude", "longitude")}
        for one in self.channels:
            if one.channel not in earth:
                lines.append(f"  {one.channel}: {_source(one)}  # {100 * one.certainty:.0f} %: {one.reason}")
        if len(earth) == 2:
            factor = earth["latitude"].factor / DEG
            scaled = "" if np.isclose(factor, 1) else f", factor: {factor:.9g}"
            names = ", ".join(f"{name}: {_quoted(one.column)}" for name, one in sorted(earth.items()))
            lines.append(f"position_from: {{{names}{scaled}}}")
        if self.run is not None:
            lines.append(f"run: {_quoted(self.run)}")
        for one in self.where:
            lines.append(f"where: {{{_quoted(one.column)}: {{min: {one.min:g}}}}}")
        if self.rate is not None:
            lines.append(f"rate: {self.rate:g}  # Hz")
        if self.stamps != "header":
            lines.append(f"stamps: {self.stamps}")
        return "\n".join([*lines, *(f"# {sentence}" for sentence in self.open)]) + "\n"

    def write(self, path: Path) -> None:
        """Write `yaml` to `path`; raises `BadInput` if there is such a file."""
        if path.exists():
            raise BadInput(f"{path}: is there already; give the name of a new file.")
        try:
            write_text(path, self.yaml())
        except OSError as error:
            raise BadInput(f"{path}: cannot be written ({error.strerror}); give another path.") from None

    def __str__(self) -> str:
        width = max([len(one.column) for one in self.channels] + [6])
        lines = [
            f"{'channel':9} {'column':{width}} {'factor':>11} {'offset':>9} {'certain':>7} {'late by':>8}  because"
        ]
        for one in self.channels:
            late = "" if one.delay is None else f"{1000 * one.delay:+.0f} ms"
            lines.append(f"{one.channel:9} {one.column:{width}} {one.factor:11.6g} {one.offset:9.4g} "
                         f"{100 * one.certainty:5.0f} % {late:>8}  {one.reason}")  # fmt: skip
        return "\n".join([*lines, "", *self.open]).rstrip()


def guess_columns(path: str | Path, *, wheelbase: float | None = None) -> Guess:
    """Propose a column map for a log of any format that `read_log` reads; raises `BadInput` as that does.

    Columns are recognised by name and unit, and by how they follow each other: which sign and unit a yaw rate has,
    which of two speeds is that of the position, how late a channel is. The car's `wheelbase` [m] tells a steering
    wheel from a road wheel.
    """
    log = read_log_columns(Path(path))
    assigned = assign_channels(log)
    v = channel_signals(assigned, log.dt)
    left: list[str] = []
    assigned = _without_course(assigned, v, log.dt, left)
    assigned = _without_refuted(assigned, v, log.dt, left)
    if {"latitude", "longitude"} <= set(assigned):
        assigned = {role: one for role, one in assigned.items() if role not in ("x", "y")}
    assigned = _one_pair_of_speeds(assigned)
    _note_turned(assigned, left)
    assigned = _steering_ratio(assigned, wheelbase, left)
    v = channel_signals(assigned, log.dt)
    offset = heading_offset(untransformed_signals(assigned, log.dt))
    guesses = [Guessed("t", log.time, log.time_factor, 0.0, 1.0, "rises steadily", None)]
    for role in sorted(assigned, key=lambda role: ORDER.index(role) if role in ORDER else len(ORDER)):
        guesses.append(_guessed(assigned[role], v, log.dt, offset if role == "psi" else None))
    lacks = [name for name in CHANNELS if not _provided(name, assigned)]
    where, rate = _forwards(assigned, v, left), _even_rate(log, guesses, left)
    left += _open(log, assigned, lacks, guesses)
    return Guess(Path(path), tuple(guesses), log.run, log.stamps, tuple(left), where, rate)


def _forwards(assigned: dict[str, ChannelAssignment], v: dict[str, Signal], left: list[str]) -> tuple[Condition, ...]:
    """Return the condition that leaves out rows driven backwards, if there are any."""
    role = next((role for role in ("V", "vx") if role in v), None)
    if role is None:
        return ()
    one = assigned[role]
    speed = one.factor * one.column.y  # as it is read, not smoothed
    back = np.mean(speed[np.isfinite(speed)] < 0)
    if not back or (role == "vx" and np.nanmin(speed) > -NEAR_ZERO):  # a speed `V` below zero is refused, however small
        return ()
    least = float(f"{SLOW * np.nanpercentile(v[role].y, 99) / one.factor:.2g}")
    left.append(f"'{one.column.name}' is negative in {100 * back:.2g} % of the samples, driven backwards: rows below "
                f"{least:g} are left out.")  # fmt: skip
    return (Condition(one.column.name, min=least),)


def _even_rate(log: LogColumns, guesses: list[Guessed], left: list[str]) -> float | None:
    """Return the rate to resample uneven samples to; None where those of the fastest measured column are even."""
    measured = [one.column for one in guesses if one.channel not in ("t", *COMMANDS)]
    rates = [log.rates[name] for name in measured if name in log.rates]
    if not rates:
        return None
    rate = proposed_rate(max(rates))
    left.append(f"The time steps are uneven: the log is resampled to {rate:g} Hz.")
    return rate


def _without_course(
    assigned: dict[str, ChannelAssignment], v: dict[str, Signal], dt: float, left: list[str]
) -> dict[str, ChannelAssignment]:
    """Remove a heading that is the direction of travel, as from GPS, where the sideslip tells the two apart."""
    slip = v["beta"].y if "beta" in v else np.arctan2(v["vy"].y, v["vx"].y) if {"vx", "vy"} <= set(v) else None
    if "psi" not in v or slip is None or (way := course(v)) is None:
        return assigned
    moving = fast(v, len(slip))
    apart = np.angle(np.exp(1j * (way[0] - v["psi"].y)))[moving]
    rest = lambda y: float(np.nanstd(np.angle(np.exp(1j * (y - np.nanmedian(y))))))
    if np.isfinite(apart - slip[moving]).sum() < 50 or rest(apart) > 0.5 * rest(apart - slip[moving]):
        return assigned
    name = assigned["psi"].column.name
    left.append(f"'{name}' is the direction of travel, not the heading of the car; it was left out.")
    return {role: one for role, one in assigned.items() if role != "psi"}


def _without_refuted(
    assigned: dict[str, ChannelAssignment], v: dict[str, Signal], dt: float, left: list[str]
) -> dict[str, ChannelAssignment]:
    """Remove accelerations by name that follow nothing that they should, as those of another frame."""
    for role in ("ax", "ay"):
        if role not in assigned or assigned[role].fit is not None:
            continue
        one = assigned[role]
        moving = fast(v, len(one.signal.y))
        fits = [fit_relation(rule, one.signal, moving) for rule in kinematic_relations(role, v, dt)]
        there = [fit for fit in fits if fit is not None]
        if there and all(abs(fit.correlation) < REFUTED for fit in there):
            left.append(f"'{one.column.name}' is named like {role} but does not follow {there[0].relation.name} "
                        f"({there[0].correlation:.2f}); it was left out.")  # fmt: skip
            assigned = {other: each for other, each in assigned.items() if other != role}
    return assigned


def _note_turned(assigned: dict[str, ChannelAssignment], left: list[str]) -> None:
    if {"ax", "ay"} <= set(assigned) and meaning(assigned["ay"].column.name).name_score["ax"] > LEAST:
        ax, ay = assigned["ax"].column.name, assigned["ay"].column.name
        left.append(f"'{ay}' follows the acceleration to the left, '{ax}' that forwards or backwards: the sensor is "
                    "mounted a quarter turn to the side.")  # fmt: skip


def _one_pair_of_speeds(assigned: dict[str, ChannelAssignment]) -> dict[str, ChannelAssignment]:
    """Return the channels with vx and vy or V and beta, whichever pair is there and fits better.

    Without vy a vx stands for V, unless another column is V by its name and fits better.
    """
    pairs = {pair: min(assigned[role].score for role in pair)
             for pair in (("vx", "vy"), ("V", "beta")) if set(pair) <= set(assigned)}  # fmt: skip
    if pairs:
        best = max(pairs, key=pairs.__getitem__)
        drop = {"vx", "vy", "V", "beta"} - set(best)
    elif "vx" in assigned:
        ahead, speed = assigned["vx"]._replace(role="V"), assigned.get("V")
        named = speed is not None and meaning(speed.column.name, speed.column.unit).name_score["V"] > UNKNOWN
        assigned = assigned | {"V": max(speed, ahead, key=lambda one: one.score) if speed and named else ahead}
        drop = {"vx"}
    else:
        drop = set()
    return {role: one for role, one in assigned.items() if role not in drop}


def _steering_ratio(
    assigned: dict[str, ChannelAssignment], wheelbase: float | None, left: list[str]
) -> dict[str, ChannelAssignment]:
    """Return the channels with a steering wheel's angle divided by the ratio, where the wheelbase determines it."""
    steer = assigned.get("delta")
    if steer is None or steer.fit is None or abs(steer.fit.correlation) < 0.9:
        return assigned
    length = abs(steer.factor / steer.fit.factor)  # wheelbase if it is the road wheel's angle
    if wheelbase is not None and length > 2.5 * wheelbase:
        left.append(f"'{steer.column.name}' turns {length / wheelbase:.1f} times as far as the road wheels would; it "
                    "was taken for the steering wheel's.")  # fmt: skip
        return assigned | {"delta": steer._replace(factor=steer.factor * wheelbase / length)}
    if wheelbase is None and length > LENGTHS[1]:
        left.append(f"'{steer.column.name}' looks like the steering wheel's angle: give --vehicle, or divide the "
                    "factor of delta by the steering ratio.")  # fmt: skip
    return assigned


def _guessed(one: ChannelAssignment, v: dict[str, Signal], dt: float, offset: float | None) -> Guessed:
    certainty, reason, delay = one.score, "by name", None
    if one.fit is not None:
        rule = one.fit.relation
        reason = f"follows {rule.name} ({abs(one.fit.correlation):.2f})"
        signal = v[one.role].rate if rule.of_rate else v[one.role].y
        if abs(one.fit.correlation) > 0.8 and not np.isnan(shift := time_shift([(signal, rule.predicted)], dt).value):
            delay = round(shift, 4)
    elif one.role in SIGNED:
        certainty *= UNSURE
        reason += "; nothing tells its sign"
    if one.rival is not None:
        certainty *= UNSURE
        reason += f"; '{one.rival}' fits as well"
    turn = 0.0
    if offset is not None and abs(offset) > NEAR_ANGLE:
        nearest = RIGHT_ANGLE * round(offset / RIGHT_ANGLE)
        turn = nearest if abs(offset - nearest) < NEAR_ANGLE else offset
    return Guessed(one.role, one.column.name, _rounded(one.factor), float(turn), round(min(certainty, 1.0), 3), reason,
                   delay)  # fmt: skip


def _rounded(factor: float) -> float:
    return float(f"{factor:.10g}")


def _provided(name: str, assigned: dict[str, ChannelAssignment]) -> bool:
    if name in ("V", "beta") and {"vx", "vy"} <= set(assigned):
        return True
    return name == "t" or name in assigned


def _open(
    log: LogColumns, assigned: dict[str, ChannelAssignment], lacks: list[str], guesses: list[Guessed]
) -> list[str]:
    """Return sentences about channels without a column, and columns without a channel."""
    may_lack = dispensable(assigned)
    needed = [name for name in lacks if name not in may_lack]
    sentences = [f"No column was recognised as {', '.join(needed)}, which the diagnosis needs."] if needed else []
    sentences += [f"No column was recognised as {name}: {OPTIONAL[name]}." for name in lacks if name in may_lack]
    used = {one.column for one in guesses}
    rest = [one.name for one in log.columns if one.name not in used]
    pedals = [name for name in rest if PEDALS & set(words_of(name))]
    if "Fxr" in lacks and pedals:
        sentences.append(f"The drive force may follow from {_list(pedals)}: write 'Fxr_from'.")
    if log.flags:
        sentences.append(f"Rows may be chosen by {_list(log.flags)}: write 'where'.")
    if rest:
        sentences.append(f"No channel was found for {_list(rest)}.")
    if log.absurd:
        sentences.append(f"Values of absurd size in {_list(log.absurd)} were not compared.")
    if log.constant:
        sentences.append(f"Nothing changes in {_list(log.constant)}.")
    return sentences


def _list(names: list[str], most: int = 12) -> str:
    return ", ".join(f"'{name}'" for name in names[:most]) + (
        f" and {len(names) - most} more" if len(names) > most else ""
    )


def _source(one: Guessed) -> str:
    parts = [f"column: {_quoted(one.column)}"]
    parts += [f"factor: {_float(one.factor)}"] if one.factor != 1 else []
    parts += [f"offset: {_float(one.offset)}"] if one.offset else []
    return _quoted(one.column) if len(parts) == 1 else "{" + ", ".join(parts) + "}"


def _float(value: float) -> str:
    return repr(float(f"{value:.10g}"))


def _quoted(name: str) -> str:
    """Return a name as YAML within braces reads it."""
    plain = re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name) and isinstance(yaml.safe_load(name), str)
    return name if plain else yaml.safe_dump(name, default_style='"', width=10**6).strip()
