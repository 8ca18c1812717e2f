"""Score a study: rates and means with their intervals and targets."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

from driftjax.core import from_dict
from driftjax.core.intervals import half_width
from driftjax.studies.hidden_effects import criteria
from driftjax.studies.hidden_effects.case import Case
from driftjax.studies.hidden_effects.criteria import Result


@dataclass(frozen=True)
class Measure:
    """One measured number with its interval and target."""

    value: float  # NaN where nothing was measured
    n: int
    low: float = float("nan")
    high: float = float("nan")
    target: str = ""


def rate_interval(hits: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (Wilson 1927)."""
    ends = binomtest(hits, n).proportion_ci(method="wilson") if n else (float("nan"),) * 2
    return float(ends[0]), float(ends[1])


def rate(flags: Iterable[bool], target: str = "") -> Measure:
    """Return the share of true values with its interval."""
    values = list(flags)
    hits, n = sum(values), len(values)
    return Measure(hits / n if n else float("nan"), n, *rate_interval(hits, n), target)


def mean(values: Iterable[float], target: str = "") -> Measure:
    """Return the mean with its 95 % interval by Student's t; NaN for fewer than three values."""
    data = np.array(list(values), float)
    if len(data) == 0:
        return Measure(float("nan"), 0, target=target)
    half = half_width(data)
    return Measure(float(data.mean()), len(data), float(data.mean() - half), float(data.mean() + half), target)


def score_results(results: list[Result]) -> dict[str, Measure]:
    """Return all measures; failed results are counted separately."""
    good = [r for r in results if "error" not in r]
    table = {"failed": Measure(len(results) - len(good), len(results), target="0")}
    for car in sorted({r["case"]["car"] for r in good}):
        own = [r for r in good if r["case"]["car"] == car]
        table |= {
            f"{car}: {name}": m
            for name, m in (foreign_measures(own) if "height" in own[0] else car_measures(own)).items()
        }
    took = [r["seconds"] for r in good]
    table["seconds, median"] = Measure(float(np.median(took)) if took else float("nan"), len(took), target="<= 60")
    table["seconds, 9 of 10 below"] = Measure(float(np.quantile(took, 0.9)) if took else float("nan"), len(took))
    return table


def foreign_measures(results: list[Result]) -> dict[str, Measure]:
    """Return the measures of a foreign simulator."""
    return {
        "held-out gain above 0": rate((r["skill"]["extended"][1] > 0 for r in results if r["named"]), "1"),
        "held-out gain": mean((r["skill"]["extended"][0] for r in results), "> 0"),
        "height within 15 % or in the set": rate(map(criteria.height_within_tolerance, results), "1"),
    }


class _Kinds(NamedTuple):
    """Results of one car by what was hidden, and how."""

    none: list[Result]
    other: list[Result]  # nothing, with more or less sensor noise
    single: list[Result]
    quiet: list[Result]  # one effect, no process noise
    weak: list[Result]
    pair: list[Result]
    absent: list[Result]
    poor: list[Result]


def _by_kind(results: list[Result]) -> _Kinds:
    """Group the results of one car."""
    cases = [from_dict(Case, r["case"], "result") for r in results]
    pick = lambda f: [r for r, case in zip(results, cases, strict=True) if f(case)]
    return _Kinds(
        none=pick(lambda c: c.condition == "none" and c.noise == 1),
        other=pick(lambda c: c.condition == "none" and c.noise != 1),
        single=pick(lambda c: c.condition == "single" and c.scale == 1 and c.process_noise > 0),
        quiet=pick(lambda c: c.condition == "single" and c.process_noise == 0),
        weak=pick(lambda c: c.condition == "single" and c.scale < 1),
        pair=pick(lambda c: c.condition == "pair"),
        absent=pick(lambda c: c.condition == "absent"),
        poor=pick(lambda c: c.condition == "poor"),
    )


def car_measures(results: list[Result]) -> dict[str, Measure]:
    """Return the measures of one car with hidden effects."""
    none, other, single, quiet, weak, pair, absent, poor = _by_kind(results)
    sets, blind = ([r for r in poor if r["verdict"] == v and "after" in r] for v in ("SET", "DATA_INSUFFICIENT"))
    present = [*single, *quiet, *weak, *pair]
    table = {
        "nothing hidden: named something": rate(map(criteria.named_any, none), "<= 0.05"),
        "nothing hidden: said UNKNOWN": rate(r["verdict"] == "UNKNOWN" for r in none),
        "nothing hidden, noise x0.5 and x2: named": rate(map(criteria.named_any, other), "<= 0.05"),
        "one, measurement noise only: named first": rate(map(criteria.named_first, quiet), ">= 0.98"),
        "one: named first": rate(map(criteria.named_first, single), ">= 0.93"),
        "one at 0.3: named first": rate(map(criteria.named_first, weak), ">= 0.80"),
        "one (all of these): exactly that": rate(map(criteria.named_exactly, [*quiet, *single, *weak])),
        "one (all of these): named alone, verdict NAMED": rate(map(criteria.named_alone, [*quiet, *single, *weak])),
        "one (all of these): said UNKNOWN beside": rate(r["verdict"] == "UNKNOWN" for r in [*quiet, *single, *weak]),
        "two: both found": rate(map(criteria.named_all, pair), ">= 0.95"),
        "two: exactly these": rate(map(criteria.named_exactly, pair), ">= 0.85"),
        "two: exactly these, verdict NAMED": rate(map(criteria.named_alone, pair)),
        "absent from the catalogue: not NAMED": rate((r["verdict"] != "NAMED" for r in absent), ">= 0.85"),
        "absent: named what fits as well as the truth": rate(map(criteria.imitates_truth, absent)),
        "absent: driving variable in the first two": rate(map(criteria.names_driving_variable, absent), ">= 0.75"),
        "poor log: named something else": rate(map(criteria.misnamed, poor), "<= 0.05"),
        "poor log, SET: resolved by the manoeuvre proposed": rate(map(criteria.resolved_by_manoeuvre, sets), ">= 0.90"),
        "poor log, DATA_INSUFFICIENT: resolved by it": rate(map(criteria.resolved_by_manoeuvre, blind)),
        "95 % intervals: coverage": rate(
            (x for r in [*single, *weak, *pair] for x in criteria.interval_hits(r)), "0.90..0.98"
        ),
        "95 % intervals: coverage, measurement noise only": rate(x for r in quiet for x in criteria.interval_hits(r)),
        "reported set: mean size": mean(
            (len(criteria.reported_set(c)) for r in present for c in r["causes"]), "<= 1.5"
        ),
        "share of the explainable removed": mean(criteria.removed_shares(present), ">= 0.9"),
        "named, yet worse on runs held out": rate((criteria.worse_than_nominal(r) for r in present if r["named"]), "0"),
        "calibration error of the probability": Measure(
            criteria.calibration_error(present), len(present), target="<= 0.05"
        ),
        "nothing hidden: p-values uniform (KS p)": Measure(
            criteria.uniformity_p_value(none), len(none), target="> 0.01"
        ),
    }
    return {name: measure for name, measure in table.items() if measure.n}


def as_json(table: dict[str, Measure]) -> dict[str, Any]:
    """Return the table as plain values."""
    return {name: asdict(measure) for name, measure in table.items()}


def as_text(table: dict[str, Measure]) -> str:
    """Format the table with its targets."""
    width = max(map(len, table))
    lines = [f"{'':{width}}  {'n':>5} {'value':>7}  {'95 % interval':16} target"]
    for name, m in table.items():
        interval = f"[{m.low:.3f}, {m.high:.3f}]" if np.isfinite(m.low) else ""
        lines.append(f"{name:{width}}  {m.n:5d} {m.value:7.3f}  {interval:16} {m.target}")
    return "\n".join(lines)
