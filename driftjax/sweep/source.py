"""Where trials come from: a design laid out before, or one that follows what came out."""

import hashlib
import json
from collections.abc import Callable, Iterator
from typing import Protocol

from driftjax.sweep.config import Choices, SweepConfig
from driftjax.sweep.design import Point, num_points, points
from driftjax.sweep.trial import Outcome, Trial, Watch, Work, trial_of


class Source(Protocol):
    """Trials that are missing, in the order to run them."""

    total: int  # trials of the sweep
    kept: int  # of these, known to be kept already

    @property
    def adaptive(self) -> bool:
        """Whether the next one depends on results."""
        ...

    @property
    def watches(self) -> Callable[[Trial, SweepConfig], Watch] | None:
        """What watches a trial, in the process that runs it, and may give it up."""
        ...

    def trials(self) -> Iterator[Trial]:
        """Those to run."""
        ...

    def tell(self, outcome: Outcome) -> None:
        """What came of one."""
        ...


class Laid:
    """A design laid out before; trials that share a program follow each other.

    Of several processes each runs a `share` (which, of how many) and leaves the rest to the others.
    """

    adaptive, watches = False, None

    def __init__(self, config: SweepConfig, work: Work, known: set[str], share: tuple[int, int] = (0, 1)):
        self.config, self.work, self.known, self.share = config, work, known, share
        self.total, self.kept = num_points(config), 0

    def trials(self) -> Iterator[Trial]:
        """Each once, also where two combinations are equal."""
        seen: set[str] = set()
        whole = sorted(enumerate(points(self.config)), key=lambda pair: _program(self.config, pair[1]))
        mine, of = self.share
        whole = [pair for pair in whole if _turn(pair[1]) % of == mine]
        self.total = len(whole)
        for number, point in whole:
            trial = trial_of(self.work, self.config, number, point)
            if trial.id in seen:
                self.total -= 1
            elif trial.id in self.known:
                self.kept += 1
            else:
                yield trial
            seen.add(trial.id)

    def tell(self, outcome: Outcome) -> None:
        """Nothing follows from it."""


def _program(config: SweepConfig, point: Point) -> tuple[str, ...]:
    """What tells programs apart: values that are no floating-point numbers."""
    return tuple("" if isinstance(value, float) else repr(value) for value in point.values())


def _turn(point: Point) -> int:
    """A number that says whose turn a combination is; that of an equal one is the same."""
    return int(hashlib.sha256(json.dumps(point, sort_keys=True).encode()).hexdigest()[:8], 16)


def check(config: SweepConfig, work: Work) -> None:
    """Raise `BadInput` where the verb cannot take a value of a field by itself, beside the first of all others."""
    ends = {name: list(f.values) if isinstance(f, Choices) else [f.at(0.0), f.at(1.0)]
            for name, f in config.varied.items()}  # fmt: skip
    first = {name: values[0] for name, values in ends.items()}
    for name, values in ends.items():
        for value in values:
            trial_of(work, config, 0, first | {name: value})
