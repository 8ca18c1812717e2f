"""Rates and means with their intervals."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

Z = 1.96  # of a 95 % interval


@dataclass(frozen=True)
class Measure:
    """One measured number with its interval and target."""

    value: float  # NaN where nothing was measured
    n: int
    low: float = float("nan")
    high: float = float("nan")
    target: str = ""


def wilson(hits: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (Wilson 1927)."""
    if n == 0:
        return float("nan"), float("nan")
    rate, spread = hits / n, Z * np.sqrt(hits / n * (1 - hits / n) / n + Z**2 / (4 * n**2))
    whole = 1 + Z**2 / n
    return float((rate + Z**2 / (2 * n) - spread) / whole), float((rate + Z**2 / (2 * n) + spread) / whole)


def rate(found: Iterable[bool], target: str = "") -> Measure:
    """Return the share of true values with its interval."""
    values = list(found)
    hits, n = sum(values), len(values)
    return Measure(hits / n if n else float("nan"), n, *wilson(hits, n), target)


def mean(values: Iterable[float], target: str = "") -> Measure:
    """Return the mean with its 95 % interval."""
    found = np.array(list(values), float)
    if len(found) == 0:
        return Measure(float("nan"), 0, target=target)
    half = Z * found.std(ddof=1) / np.sqrt(len(found)) if len(found) > 1 else float("nan")
    return Measure(float(found.mean()), len(found), float(found.mean() - half), float(found.mean() + half), target)
