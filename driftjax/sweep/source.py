"""Sources of trials: the points of a fixed design, or points that depend on results."""

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterator

import numpy as np

from driftjax.sweep.config import Choices, DesignPoint, SweepConfig
from driftjax.sweep.trial import Outcome, Trial, Watch, Work, make_trial


def num_points(config: SweepConfig) -> int:
    """Return the number of trials of the design, duplicates included."""
    if config.design != "grid":
        return config.num
    return math.prod(len(values.values) for values in config.varied.values() if isinstance(values, Choices))


def points(config: SweepConfig) -> Iterator[DesignPoint]:
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


class Source:
    """Provide the missing trials in the order to run them."""

    adaptive = False  # whether the next trial depends on results
    total: int  # trials of the sweep
    num_known: int  # of these, held by the store already

    @property
    def watcher(self) -> Callable[[Trial, SweepConfig], Watch] | None:
        """Return a callback that may prune a trial, made in the process that runs it; None without pruning."""
        return None

    def trials(self) -> Iterator[Trial]:
        """Yield the trials to run."""
        raise NotImplementedError

    def record(self, outcome: Outcome) -> None:
        """Record the outcome of a trial; a fixed design ignores it."""


class DesignSource(Source):
    """Trials of a fixed design; those that share a compiled program follow each other.

    Of several processes each runs a `share` (index, number of processes).
    """

    def __init__(self, config: SweepConfig, work: Work, known: set[str], share: tuple[int, int] = (0, 1)):
        self.config, self.work, self.known, self.share = config, work, known, share
        self.total, self.num_known = num_points(config), 0

    def trials(self) -> Iterator[Trial]:
        """Yield every missing trial once, also where two combinations are equal."""
        ids: set[str] = set()
        design = sorted(enumerate(points(self.config)), key=lambda pair: _program(self.config, pair[1]))
        index, num = self.share
        design = [pair for pair in design if _hash(pair[1]) % num == index]
        self.total = len(design)
        for number, point in design:
            trial = make_trial(self.work, self.config, number, point)
            if trial.id in ids:
                self.total -= 1
            elif trial.id in self.known:
                self.num_known += 1
            else:
                yield trial
            ids.add(trial.id)


def _program(config: SweepConfig, point: DesignPoint) -> tuple[str, ...]:
    """Return the values that need a program of their own: all but floating-point numbers."""
    return tuple("" if isinstance(value, float) else repr(value) for value in point.values())


def _hash(point: DesignPoint) -> int:
    """Return a hash of a combination that assigns it to a process; equal combinations have equal hashes."""
    return int(hashlib.sha256(json.dumps(point, sort_keys=True).encode()).hexdigest()[:8], 16)


def check(config: SweepConfig, work: Work) -> None:
    """Raise `BadInput` for a value of a field that the verb refuses when all other fields have their first value."""
    ends = {name: list(f.values) if isinstance(f, Choices) else [f.value_at(0.0), f.value_at(1.0)]
            for name, f in config.varied.items()}  # fmt: skip
    first = {name: values[0] for name, values in ends.items()}
    for name, values in ends.items():
        for value in values:
            make_trial(work, config, 0, first | {name: value})
