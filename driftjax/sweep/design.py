"""Designs: which combinations of values a sweep tries."""

import itertools
import math
from collections.abc import Iterator

import numpy as np

from driftjax.sweep.config import Choices, SweepConfig, Value

Point = dict[str, Value]


def num_points(config: SweepConfig) -> int:
    """Trials that are asked for, equal ones counted each."""
    if config.design != "grid":
        return config.num
    return math.prod(len(values.values) for values in config.varied.values() if isinstance(values, Choices))


def points(config: SweepConfig) -> Iterator[Point]:
    """The combinations of a grid, of random draws or of a Latin hypercube (McKay et al. 1979), in order.

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
        yield {name: values.at(float(u)) for (name, values), u in zip(varied.items(), row, strict=True)}
