"""Confidence intervals of means of few values."""

import numpy as np
from scipy.special import stdtrit

FEWEST = 3  # values that make an interval: that of two is 12.7 standard errors wide to either side and tells nothing


def half_width(values: np.ndarray) -> float:
    """Return the half-width of the 95 % interval of the mean of `values` by Student's t; NaN of fewer than `FEWEST`."""
    num = len(values)
    return float(stdtrit(num - 1, 0.975) * np.std(values, ddof=1) / num**0.5) if num >= FEWEST else float("nan")
