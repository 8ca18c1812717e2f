"""Measured times with their spread, and rows that compare two of them."""

import math
import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, TypeVar

import jax
import numpy as np

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")
ENOUGH, BUDGET = 3, 60.0  # runs that are made however long they take; seconds from which on no more are
Sense = Literal["faster", "costs", "seconds"]


@dataclass(frozen=True)
class Timing:
    """Seconds per unit of work in each of several runs."""

    runs: tuple[float, ...]

    @property
    def median(self) -> float:
        """Return the median of the runs [s]."""
        return float(np.median(self.runs))

    @property
    def quartiles(self) -> tuple[float, float]:
        """Return the lower and upper quartile of the runs [s]."""
        low, high = np.quantile(self.runs, (0.25, 0.75))
        return float(low), float(high)

    def over(self, factor: float) -> "Timing":
        """Return the times divided by a factor."""
        return Timing(tuple(run / factor for run in self.runs))

    def as_json(self) -> dict[str, Any]:
        """Return median, quartiles and runs [s]."""
        return {"median": self.median, "quartiles": list(self.quartiles), "runs": list(self.runs)}


@dataclass(frozen=True)
class Row:
    """One comparison. `sense` says what the ratio is and which side of the target is wanted:

    `faster` is their time over ours, at least the target; `costs` ours over theirs, at most the target; `seconds`
    ours alone, at most the target. Where a peer is `missing` there is no ratio, but how to install it.
    """

    part: str
    what: str
    unit: str  # of work: solve, step, fit, plan, lap
    ours: Timing
    against: str
    theirs: Timing | None = None
    sense: Sense = "faster"
    target: float | None = None
    missing: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)  # what says whether the two sides did the same work

    @property
    def ratio(self) -> Timing | None:
        """Return the ratio of the runs, pair by pair; None without a peer."""
        if self.sense == "seconds":
            return self.ours
        if self.theirs is None:
            return None
        pairs = zip(self.theirs.runs, self.ours.runs, strict=True)
        return Timing(tuple(a / b if self.sense == "faster" else b / a for a, b in pairs))

    @property
    def met(self) -> bool | None:
        """Return whether the median ratio reaches the target; None where there is nothing to compare."""
        ratio = self.ratio
        if ratio is None or self.target is None:
            return None
        return ratio.median >= self.target if self.sense == "faster" else ratio.median <= self.target

    def as_json(self) -> dict[str, Any]:
        """Return plain values, ratio and verdict included."""
        plain = lambda timing: None if timing is None else timing.as_json()
        return {
            "part": self.part, "what": self.what, "unit": self.unit, "ours": plain(self.ours), "against": self.against,
            "theirs": plain(self.theirs), "sense": self.sense, "ratio": plain(self.ratio), "target": self.target,
            "met": self.met, "missing": self.missing, "facts": dict(self.facts),
        }  # fmt: skip


@dataclass(frozen=True)
class TimingCurve:
    """Time per unit of work against a size, for one line of a figure."""

    figure: str
    label: str
    size: str  # what the horizontal axis counts
    unit: str
    sizes: tuple[int, ...]
    seconds: tuple[float, ...]


@dataclass(frozen=True)
class PartResult:
    """Rows and curves of one part."""

    rows: list[Row]
    curves: list[TimingCurve] = field(default_factory=list)


class RecordedCall(Generic[T]):
    """Call that stores its last result, so that a timed computation need not be repeated to inspect it."""

    def __init__(self, call: Callable[[], T]):
        self._call = call
        self.last: T

    def __call__(self) -> T:
        self.last = self._call()
        return self.last


def timed(call: Callable[[], Any], units: int, at_least: float = 0.1) -> Callable[[], float]:
    """Return a function that measures the seconds per unit of one run.

    `call` does `units` of work, and is repeated within a run until that takes `at_least` [s]. Compiles and warms up
    first.
    """
    jax.block_until_ready(call())
    start = time.perf_counter()
    jax.block_until_ready(call())
    number = max(1, math.ceil(at_least / (time.perf_counter() - start)))

    def run() -> float:
        start = time.perf_counter()
        for _ in range(number):
            jax.block_until_ready(call())
        return (time.perf_counter() - start) / number / units

    return run


def alternate(repeats: int, runs: Mapping[K, Callable[[], float]], budget: float = BUDGET) -> dict[K, Timing]:
    """Measure each of `runs` `repeats` times, in turns, so that other load slows all of them alike.

    After `budget` [s] three times are enough.
    """
    rounds: list[dict[K, float]] = []
    start = time.perf_counter()
    while len(rounds) < repeats and (len(rounds) < ENOUGH or time.perf_counter() - start < budget):
        rounds.append({name: run() for name, run in runs.items()})
    return {name: Timing(tuple(one[name] for one in rounds)) for name in runs}


def measure_curve(
    repeats: int, names: tuple[str, str, str, str], sizes: tuple[int, ...], run: Callable[[int], Callable[[], float]]
) -> TimingCurve:
    """Measure the curve of figure, label, size and unit `names`; `run(size)` makes a call as `timed` does."""
    seconds = [alternate(min(3, repeats), {"one": run(size)})["one"].median for size in sizes]
    figure, label, size, unit = names
    return TimingCurve(figure, label, size, unit, sizes, tuple(seconds))
