"""Rates and means with their intervals."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import binomtest

Z = 1.96  # of a 95 % interval


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
    """Return the mean with its 95 % interval."""
    data = np.array(list(values), float)
    if len(data) == 0:
        return Measure(float("nan"), 0, target=target)
    half = Z * data.std(ddof=1) / np.sqrt(len(data)) if len(data) > 1 else float("nan")
    return Measure(float(data.mean()), len(data), float(data.mean() - half), float(data.mean() + half), target)
