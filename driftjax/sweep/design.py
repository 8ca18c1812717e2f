"""Designs: the combinations of values that a sweep runs."""

import itertools
import math
from collections.abc import Iterator

import numpy as np

from driftjax.sweep.config import Choices, SweepConfig, Value

Point = dict[str, Value]


def num_points(config: SweepConfig) -> int:
    """Return the number of trials of the design, duplicates included."""
    if config.design != "grid":
        return config.num
    return math.prod(len(values.values) for values in config.varied.values() if isinstance(values, Choices))


def points(config: SweepConfig) -> Iterator[Point]:
    """Yield the combinations of a grid, of random draws or of a Latin hypercube (McKay et al. 1979), in order.

    A random design is the beginning of any longer one of the same seed.
    """
    varied = config.varied
    if config.design == "grid":
        lists = (values.values for values in varied.values() if isinstance(values, Choices))
        yield from (dict(zip(varied, row, strict=True)) for row in itertools.product(*lists))
        return
    if config.design == "lhs":
        from scipy.stats import qmc  # takes seconds to load, in every worker

        rows = iter(qmc.LatinHypercube(len(varied), rng=np.random.default_rng(config.seed)).random(config.num))
    else:
        rng = np.random.default_rng(config.seed)
        rows = (rng.random(len(varied)) for _ in range(config.num))
    for row in rows:
        yield {name: values.value_at(float(u)) for (name, values), u in zip(varied.items(), row, strict=True)}
