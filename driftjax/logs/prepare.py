"""Convert a raw run to evenly sampled segments."""

from typing import NamedTuple

import numpy as np

from driftjax.logs import sampling
from driftjax.logs.checks import check_time, check_values, count_missing, invalid_sideslip
from driftjax.logs.columns import COMMANDS, OPTIONAL, ColumnMap
from driftjax.logs.raw import RawRun


class Segment(NamedTuple):
    """A part of a run without long gaps."""

    t: np.ndarray
    """Time [s], even."""
    values: dict[str, np.ndarray]
    """All channels but `t`."""
    dt: float
    """Sample time [s]."""
    linear: tuple[str, ...] = ()
    """Commands that change linearly between samples: means over the time to the next one."""


def prepare_segments(raw: RawRun, columns: ColumnMap | None, notes: list[str]) -> list[Segment]:
    """Return the segments of a run: checked, split at long gaps, evenly sampled, thinned to the rate of `columns`.

    Commands that are linear between samples become means over the time to the next sample.
    Repairs and omissions are appended to `notes` as sentences. Raises `BadInput` as in `driftjax.logs.checks`.
    """
    rate, linear = (columns.rate, columns.linear) if columns else (None, ())
    run = raw.select_rows(np.isfinite(raw.values["t"]))
    if lost := len(raw.lines) - len(run.lines):
        notes.append(f"{raw.where}: rows without a time were left out: {lost}.")
    if len(run.lines) < 2:
        notes.append(f"{raw.where}: was left out, for it has fewer than two rows.")
        return []
    dt = check_time(run, rate)
    every = max(dt, sampling.spacing(run.values["t"]))
    run = _checked(run, notes)
    factor = 1 if rate is None else sampling.thinning_factor(dt, rate, run.where)
    run = _hold_commands(run, every, notes)
    stretches = [run.select_rows(rows) for rows in sampling.split_at_gaps(run.values["t"], every)]
    long = [stretch for stretch in stretches if np.ptp(stretch.values["t"]) > (factor - sampling.SLACK) * dt]
    if short := sum(len(stretch.lines) for stretch in stretches) - sum(len(stretch.lines) for stretch in long):
        notes.append(f"{raw.where}: rows too few between gaps were left out: {short}.")
    if len(long) > 1:
        notes.append(f"{raw.where}: was cut at gaps into {len(long)} parts.")
    segments = [_with_means(_even(stretch, dt, every), linear) for stretch in long]
    if every > dt:
        notes.append(f"{raw.where}: its uneven time steps, {every:.3g} s or less, were resampled to {1 / dt:.4g} Hz.")
    else:
        _note_repairs(raw, long, dt, notes)
    if factor == 1:
        return segments
    notes.append(f"{raw.where}: was thinned from {1 / dt:.4g} to {1 / (dt * factor):.4g} Hz.")
    thinned = [(part, *sampling.thin(part.t, part.values, COMMANDS, factor)) for part in segments]
    return [part._replace(t=t, values=values, dt=factor * dt) for part, t, values in thinned]


def _checked(run: RawRun, notes: list[str]) -> RawRun:
    """Return the run with invalid beta set to missing; raises `BadInput` for an implausible channel."""
    void = invalid_sideslip(run)
    if void.any():
        notes.append(
            f"{run.where}: values of beta past a right angle, near standstill or rolling backwards, "
            f"count as missing: {void.sum()}."
        )
    run = run.with_channels(beta=np.where(void, np.nan, run.values["beta"]))
    check_values(run)
    for name, instead in OPTIONAL.items():
        if not np.isfinite(run.values[name]).any():
            notes.append(f"{run.where}: has no {name}; {instead}.")
    if lacking := count_missing(run):
        notes.append(f"{run.where}: values are missing: {lacking}.")
    return run


def _hold_commands(run: RawRun, dt: float, notes: list[str]) -> RawRun:
    """Hold commands over short gaps and drop the rows in long ones."""
    known, held = np.ones(len(run.lines), bool), 0
    for name in COMMANDS:
        if name in OPTIONAL and not np.isfinite(run.values[name]).any():
            continue
        values, there = sampling.hold_commands(run.values["t"], run.values[name], dt)
        held += int(np.sum(there & np.isnan(run.values[name])))
        known &= there
        run = run.with_channels(**{name: values})
    if held:
        notes.append(f"{run.where}: missing commands were taken from the sample before: {held}.")
    if not known.all():
        notes.append(f"{run.where}: rows where a command is missing for longer were left out: {np.sum(~known)}.")
    return run.select_rows(known)


def _even(run: RawRun, dt: float, every: float) -> Segment:
    values = dict(run.values)
    t = values.pop("t")
    if "psi" in values:
        values["psi"] = sampling.unwrap(values["psi"])
    if not sampling.is_uniform(t, dt):
        t, values = sampling.resample_channels(t, values, COMMANDS, dt, every)
    return Segment(t, values, dt)


def _with_means(part: Segment, linear: tuple[str, ...]) -> Segment:
    means = {name: sampling.means_to_next(part.values[name]) for name in linear}
    return part._replace(values=part.values | means, linear=linear)


def _note_repairs(raw: RawRun, stretches: list[RawRun], dt: float, notes: list[str]) -> None:
    steps = np.concatenate([np.diff(stretch.values["t"]) for stretch in stretches] or [[]]) / dt
    multiples = np.maximum(np.round(steps), 1)
    if lost := int(np.sum(multiples - 1)):
        notes.append(
            f"{raw.where}: samples are lost; measured values count as missing there, commands are held: {lost}."
        )
    if (uneven := np.abs(steps - multiples) > sampling.UNIFORM).any():
        notes.append(
            f"{raw.where}: {uneven.sum()} of {steps.size} time steps differ from {dt:.4g} s; "
            "the run was resampled evenly."
        )
