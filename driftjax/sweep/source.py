"""Sources of trials: a fixed design, or one that depends on results."""

import hashlib
import json
from collections.abc import Callable, Iterator

from driftjax.sweep.config import Choices, SweepConfig
from driftjax.sweep.design import Point, num_points, points
from driftjax.sweep.trial import Outcome, Trial, Watch, Work, make_trial


class Source:
    """Provide the missing trials in the order to run them."""

    adaptive = False  # whether the next trial depends on results
    total: int  # trials of the sweep
    num_known: int  # of these, held by the store already

    @property
    def watcher(self) -> Callable[[Trial, SweepConfig], Watch] | None:
        """Callback that may prune a trial, made in the process that runs it; None without pruning."""
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


def _program(config: SweepConfig, point: Point) -> tuple[str, ...]:
    """Return the values that need a program of their own: all but floating-point numbers."""
    return tuple("" if isinstance(value, float) else repr(value) for value in point.values())


def _hash(point: Point) -> int:
    """Return a hash of a combination that assigns it to a process; equal combinations have equal hashes."""
    return int(hashlib.sha256(json.dumps(point, sort_keys=True).encode()).hexdigest()[:8], 16)


def check(config: SweepConfig, work: Work) -> None:
    """Raise `BadInput` where the verb cannot take a value of a field by itself, beside the first of all others."""
    ends = {name: list(f.values) if isinstance(f, Choices) else [f.value_at(0.0), f.value_at(1.0)]
            for name, f in config.varied.items()}  # fmt: skip
    first = {name: values[0] for name, values in ends.items()}
    for name, values in ends.items():
        for value in values:
            make_trial(work, config, 0, first | {name: value})
