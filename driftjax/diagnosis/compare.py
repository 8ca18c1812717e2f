"""Compare two logs of similar manoeuvres: name the differences, and the share of the gap that they close."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from driftjax.core import BadInput
from driftjax.diagnosis.contrast import (
    Contrast,
    Pair,
    Sizes,
    difference_scores,
    fit_pair,
    fit_together,
    p_value_of,
    prefer_refitted,
    probabilities,
    search_differences,
)
from driftjax.diagnosis.evidence import RIVAL_PROBABILITY, SURE_PROBABILITY
from driftjax.diagnosis.fit import Problem, initial_problem, with_estimated_noise, with_noise
from driftjax.diagnosis.gain import DECISIVE
from driftjax.diagnosis.gap import Gap, Overlap, gap_json, measure_gap, overlaps
from driftjax.diagnosis.held_out import check_naming
from driftjax.diagnosis.naming import name_effects
from driftjax.diagnosis.noise_model import Noise
from driftjax.diagnosis.predictive_naming import TOLERATED
from driftjax.diagnosis.resolve import resolved_log
from driftjax.diagnosis.rivals import share_among_alike
from driftjax.diagnosis.select import MAX_EFFECTS, Selection
from driftjax.diagnosis.verdict import (
    MIN_DETECTABLE_SHARE,
    MIN_DURATION,
    Explained,
    Judgement,
    Verdict,
    detectable_share,
)
from driftjax.environment import require_float64
from driftjax.logs import Log
from driftjax.logs.checks import check_rates
from driftjax.store import RunFolder
from driftjax.store.files import write_json
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import EFFECTS, Effect, default_catalogue
from driftjax.vehicle.effect.families import FAMILY_OF

ROUNDS = 3  # of fitting both logs and searching for differences, at most
NO_FORCE = ("A log has no drive force; in both that which explains the measured speed was used, so that drive, brakes "
            "and drag are not compared.")  # fmt: skip
OWN_LOST = 0.1  # error of the nominal car over that of a log's own car below which that one is no yardstick
LITTLE = 0.3  # overlap of a channel below which two logs hardly share its range


@dataclass(frozen=True)
class CompareConfig:
    """Options of a comparison of two logs."""

    without: tuple[str, ...] = ()
    """Effects left out of the catalogue."""
    most: int = MAX_EFFECTS
    """Differences named at most, and effects named in each log."""
    unexplained: float = TOLERATED
    """Share of the gap between the logs that may stay open: the verdict is UNKNOWN only where more does."""
    seed: int = 0
    """Of the random signs of the test and of the resampling."""

    def __post_init__(self) -> None:
        check_naming(self.most, self.unexplained, self.seed, self.without)


class Difference(NamedTuple):
    """One effect that differs between the logs, in SI, as compare.json holds it."""

    effect: str
    probability: float  # that it rather than a rival differs
    p_value: float  # of its own difference beside the others, adjusted for all effects
    parameters: dict[str, dict[str, Any]]  # name -> a, a_error, b, b_error, difference, ci95, unit, at_bound; SI
    rivals: dict[str, float]  # effects that might differ in its place, with their probabilities
    family: str


@dataclass(frozen=True)
class LogComparison:
    """Result of a comparison: differences between two logs of one car, and the gap that they cause."""

    vehicle: VehicleConfig
    """The nominal car."""
    logs: tuple[Log, Log]
    config: CompareConfig
    judgement: Judgement
    differences: tuple[Difference, ...] = ()
    """Every effect whose size differs, the most certain first."""
    named: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    """Effects that each log by itself shows the nominal car to lack."""
    gap: tuple[Gap, Gap] | None = None
    """Prediction errors on A, and on B; None where a log is too short."""
    overlap: dict[str, Overlap] = dataclasses.field(default_factory=dict)
    """What the logs share of the range of each channel."""

    @property
    def verdict(self) -> Verdict:
        """Return the verdict on the differences: NOTHING, NAMED, SET, UNKNOWN or DATA_INSUFFICIENT."""
        return self.judgement.verdict

    @property
    def sentence(self) -> str:
        """Return the verdict in words, with units."""
        return self.judgement.sentence

    def content(self) -> dict[str, Any]:
        """Return the content of compare.json, schema version 1."""
        return {
            "schema": 1, "verdict": str(self.verdict), "sentence": self.sentence,
            "differences": [one._asdict() for one in self.differences],
            "named": {"a": list(self.named[0]), "b": list(self.named[1])},
            "gap": {name: gap_json(one) for name, one in zip("ab", self.gap, strict=True)} if self.gap else None,
            "overlap": {name: one._asdict() for name, one in self.overlap.items()},
            "data": {name: {"sha256": log.sha256, "rows": log.rows, "notes": list(log.notes)}
                     for name, log in zip("ab", self.logs, strict=True)},
            "config": dataclasses.asdict(self.config), "seed": self.config.seed,
        }  # fmt: skip

    def save(self, folder: str | Path) -> Path:
        """Write compare.json into `folder`, a run folder of `driftjax compare`; `write_comparison` adds the report."""
        folder = RunFolder.ensure(folder, compare_settings(self.vehicle, self.logs, self.config), "compare").path
        write_json(folder / "compare.json", self.content())
        return folder


def compare_settings(vehicle: VehicleConfig, logs: tuple[Log, Log], config: CompareConfig) -> dict[str, Any]:
    """Return the content of config.yaml of a comparison."""
    read = [log.reading for log in logs]
    both = {key: [one.get(key) for one in read] for key in ("columns", "runs", "cut")}
    named = {name: one.get("logs") for name, one in zip("ab", read, strict=True)}
    return {"vehicle": dataclasses.asdict(vehicle)} | named | both | {"options": dataclasses.asdict(config)}


def compare(
    vehicle: VehicleConfig,
    log_a: Log,
    log_b: Log,
    config: CompareConfig | None = None,
    *,
    report: Callable[[str], None] = lambda text: None,
    effects: tuple[Effect, ...] | None = None,
) -> LogComparison:
    """Compare two logs of `vehicle` in similar manoeuvres, from measurements in SI, left positive.

    The logs may be of a real car and of any simulator, of a wet and a dry road, from before and after a repair.
    An error of the nominal car that both logs share is no difference: only its change is tested. `report` is called at
    every step. Raises `BadInput` for logs whose sample times differ.
    """
    require_float64()
    config = CompareConfig() if config is None else config
    check_alike(log_a, log_b)
    log_a, log_b = (resolved_log(vehicle, log) for log in (log_a, log_b))
    logs = log_a, log_b
    durations = [sum(len(run.t) * run.dt for run in log.runs) for log in logs]
    for name, duration in zip("AB", durations, strict=True):
        if duration < MIN_DURATION:
            text = f"Log {name} holds {duration:.1f} s; at least {MIN_DURATION:.0f} s are needed to tell anything."
            return LogComparison(vehicle, logs, config, Judgement(Verdict.DATA_INSUFFICIENT, text))
    effects = default_catalogue(*(one.effect for one in vehicle.effects)) if effects is None else effects
    report("noise and naming: compile")
    problems, selections = _name_both(vehicle, logs, config, effects, report)
    report("differences")
    pair, selected = find_differences(problems, selections, config)
    report("gap")
    gap = measure_gap(pair, 0, selected, config.seed), measure_gap(pair, 1, selected, config.seed)
    contrast, sizes = fit_together(pair, selected)
    differences = _differences(pair, contrast, selected, sizes, config.seed)
    overlap = overlaps(log_a.runs, log_b.runs)
    judgement = judge(pair, differences, gap, overlap, config, min(durations))
    names = [tuple(pair.problems[0].effects[i].name for i in one.selected) for one in selections]
    return LogComparison(vehicle, logs, config, judgement, differences, (names[0], names[1]), gap, overlap)


def check_alike(log_a: Log, log_b: Log) -> None:
    """Raise `BadInput` unless both logs have one sample time and are not the same data."""
    if log_a.sha256 and log_a.sha256 == log_b.sha256 and {r.name for r in log_a.runs} & {r.name for r in log_b.runs}:
        raise BadInput("A and B hold the same runs; give two logs, or other runs of one.")
    check_rates({f"A: {log_a.runs[0].name}": log_a.runs[0].dt, f"B: {log_b.runs[0].name}": log_b.runs[0].dt})


def _name_both(
    vehicle: VehicleConfig, logs: tuple[Log, Log], config: CompareConfig, effects: tuple[Effect, ...],
    report: Callable[[str], None],
) -> tuple[tuple[Problem, Problem], tuple[Selection, Selection]]:  # fmt: skip
    """Name what the nominal car gets wrong in each log; return also both problems, with the same noise.

    The innovations that a wrong model causes depend on the assumed noise. With the larger noise of the two logs in
    both, errors that they share cancel.
    """
    both = initial_problem(vehicle, effects, logs[0].runs + logs[1].runs, config.without)
    first = len(logs[0].runs)
    parts = (np.arange(first), np.arange(first, first + len(logs[1].runs)))

    def name(which: int) -> tuple[Problem, Selection]:
        problem = both.subset(parts[which])
        problem = with_estimated_noise(problem, problem.start, problem.active)
        words = lambda text: report(f"noise and naming: {'AB'[which]}, {text.removeprefix('naming: ')}")
        return name_effects(problem, config.seed, config.most, words)

    with ThreadPoolExecutor(2) as threads:
        (near_a, named_a), (near_b, named_b) = threads.map(name, (0, 1))
    noise = larger_noise(near_a.noise, near_b.noise)
    alike = lambda near, selection: with_noise(near, selection.fit.theta, noise)
    return (alike(near_a, named_a), alike(near_b, named_b)), (named_a, named_b)


def larger_noise(first: Noise, second: Noise) -> Noise:
    """Return the larger noise of every channel, with the geometric mean of the correlation times."""
    one, other = first.as_vector(), second.as_vector()
    larger, between = Noise.from_vector(np.maximum(one, other)), Noise.from_vector(np.sqrt(one * other))
    return larger._replace(correlation=between.correlation, slow_correlation=between.slow_correlation)


def find_differences(
    problems: tuple[Problem, Problem], selections: tuple[Selection, Selection], config: CompareConfig
) -> tuple[Pair, tuple[int, ...]]:
    """Fit both logs with the effects named in either, and return the effects whose sizes differ."""
    effects = tuple(sorted({*selections[0].selected, *selections[1].selected}))
    pair, selected = fit_pair(problems, effects, (selections[0].fit.theta, selections[1].fit.theta)), ()
    for _ in range(ROUNDS):
        selected = search_differences(pair.contrast, config.seed, config.most)
        if set(selected) <= set(pair.effects):
            break
        effects = tuple(sorted({*pair.effects, *selected}))
        pair = fit_pair(problems, effects, (pair.fits[0].theta, pair.fits[1].theta))
    return prefer_refitted(pair, tuple(i for i in selected if i in pair.effects))


def _differences(
    pair: Pair, contrast: Contrast, selected: tuple[int, ...], sizes: Sizes, seed: int
) -> tuple[Difference, ...]:
    """Return the differences in SI, the most certain first."""
    problem, differences = pair.problems[0], []
    columns, scale = problem.columns(selected), np.asarray(problem.model.scale)
    apart = np.zeros(len(scale))
    apart[columns] = sizes.difference
    for i in selected:
        share = probabilities(pair.contrast, selected, i, pair.refitted)
        share = share_among_alike(problem, selected, apart, i, share)
        rivals = {problem.effects[j].name: float(share[j]) for j in np.argsort(-share)
                  if j != i and share[j] > RIVAL_PROBABILITY}  # fmt: skip
        parameters = {}
        for p, k in zip(problem.effects[i].parameters, problem.columns((i,)), strict=True):
            at = int(np.searchsorted(columns, k))
            a, b, a_error, b_error, d, half = (
                float(values[at] * scale[k])
                for values in (sizes.first, sizes.second, sizes.first_error, sizes.second_error, sizes.difference,
                               sizes.half_width)
            )  # fmt: skip
            ends = [x in (problem.lower[k], problem.upper[k]) and x != 0 for x in (sizes.first[at], sizes.second[at])]
            parameters[p.name] = {
                "a": a, "a_error": a_error, "b": b, "b_error": b_error, "difference": d, "ci95": [d - half, d + half],
                "unit": p.unit, "at_bound": any(ends),
            }  # fmt: skip
        name = problem.effects[i].name
        p_value = p_value_of(contrast, selected, i, seed)
        differences.append(Difference(name, float(share[i]), p_value, parameters, rivals, FAMILY_OF[name]))
    return tuple(sorted(differences, key=lambda one: (-one.probability, one.p_value)))


def judge(
    pair: Pair, differences: tuple[Difference, ...], gap: tuple[Gap, Gap], overlap: dict[str, Overlap],
    config: CompareConfig, duration: float,
) -> Judgement:  # fmt: skip
    """Return the verdict on the differences, and its reason.

    UNKNOWN says that more than `config.unexplained` of the gap on either log is certainly left.
    """
    words = [describe(one) for one in differences]
    gaps = [f"{gap_sentence(one, names, bool(differences))}" for one, names in zip(gap, ("BA", "AB"), strict=True)]
    limits = range_sentence(overlap) + ([] if pair.problems[0].data.force_known else [NO_FORCE])
    if any(exceeds_tolerance(one, config.unexplained) for one in gap):
        named = ", ".join(one.effect for one in differences)
        text = f"Something differs that no effect of the catalogue explains{', beside ' + named if named else ''}."
        return Judgement(Verdict.UNKNOWN, " ".join([text, *words, gaps[1], gaps[0], *limits]))
    if not differences:
        H = difference_scores(pair.contrast, np.zeros_like(pair.problems[0].start), (), config.seed).H
        share = detectable_share(pair.problems[0], H)
        if share < MIN_DETECTABLE_SHARE:
            text = f"These logs hardly show differences: only {100 * share:.0f} % of the effects would stand out."
            return Judgement(Verdict.DATA_INSUFFICIENT, " ".join([text, *limits]))
        text = f"Nothing differs that {duration:.0f} s of each log could show."
        return Judgement(Verdict.NOTHING, " ".join([text, gaps[1], *limits]))
    bound = any(row["at_bound"] for one in differences for row in one.parameters.values())
    sure = all(one.probability >= SURE_PROBABILITY for one in differences) and not bound
    return Judgement(Verdict.NAMED if sure else Verdict.SET, " ".join([*words, gaps[1], *limits]))


def exceeds_tolerance(gap: Gap, tolerated: float) -> bool:
    """Return whether more than the share `tolerated` of the gap is surely left, or it is unsure that most is closed."""
    if gap.closed is None:
        return False
    one = gap.closed
    return Explained(one.value, one.ci95, one.remaining, one.remaining_ci95, 0.0, gap.held_out).unexplained_exceeds(
        tolerated
    )


def describe(one: Difference) -> str:
    """Describe a difference in words."""
    effect = EFFECTS.get(one.effect)
    suffix = lambda row: "" if row["unit"] == "1" else f" {row['unit']}"
    values = [
        f"{name} = {row['a']:.3g} ± {1.96 * row['a_error']:.2g} in A, {row['b']:.3g} ± {1.96 * row['b_error']:.2g} in "
        f"B, a difference of {row['difference']:.3g} ± {row['ci95'][1] - row['difference']:.2g}{suffix(row)}"
        for name, row in one.parameters.items()
    ]
    text = f"{one.effect} differs"
    text += f" ({effect.sentence})" if effect else ""
    text += f": {'; '.join(values)} (P = {one.probability:.2f})."
    if one.probability < SURE_PROBABILITY and one.rivals:
        others = ", ".join(f"{name} ({p:.2f})" for name, p in list(one.rivals.items())[:3])
        text += f" These logs do not rule out {others}."
    return text


def gap_sentence(gap: Gap, names: str, named: bool) -> str:
    """Describe how much worse the car of log `names[0]` predicts log `names[1]`, and what share differences close."""
    worse, low, high = gap.decisive
    if not np.isfinite(worse):
        return f"No run of {names[1]} is long enough to measure the gap."
    if gap.ratio["nominal"][DECISIVE, -1, 0] < OWN_LOST:
        return (f"The gap on {names[1]} is not measured: its own car errs far more than the nominal one, as where the "
                "observer loses it; start from a car nearer to the real one.")  # fmt: skip
    text = (f"The car of {names[0]} predicts {names[1]} with {worse:.2f} [{low:.2f}, {high:.2f}] times the error of "
            f"{names[1]}'s own {gap.models['own'].horizons[DECISIVE]:.2g} s ahead")  # fmt: skip
    if not named or gap.closed is None:
        return f"{text}."
    if not np.isfinite(gap.closed.value):
        return f"{text}, which leaves a gap in doubt."
    low, high = (100 * end for end in gap.closed.ci95)
    return f"{text}; the named differences close {100 * gap.closed.value:.0f} % [{low:.0f}, {high:.0f}] of that gap."


def range_sentence(overlap: dict[str, Overlap]) -> list[str]:
    """Describe the channels whose ranges barely overlap; empty without any."""
    short = {name: one for name, one in overlap.items() if one.share < LITTLE}
    if not short:
        return []
    each = [f"{name} ({100 * one.share:.0f} %: {one.first[0]:.3g} to {one.first[1]:.3g} in A, {one.second[0]:.3g} to "
            f"{one.second[1]:.3g} in B)" for name, one in short.items()]  # fmt: skip
    return [f"The logs hardly share the range of {', '.join(each)}: what differs may be what one log alone drives."]
