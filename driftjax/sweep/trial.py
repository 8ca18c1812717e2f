"""One trial of a sweep: its id, how it runs, and its outcome."""

import hashlib
import json
import math
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from driftjax.core import BadInput, set_option
from driftjax.parallel import BatchExecutor, source_hash
from driftjax.sweep.config import DesignPoint, SweepConfig, Value

TrialRow = dict[str, Value]
Watch = Callable[[int, float], bool]  # of a step and the mean objective up to it: whether to give the trial up


@dataclass(frozen=True)
class Work:
    """How a sweep runs a verb; the functions are defined at module level, so that workers can import them."""

    complete: Callable[[dict[str, Any]], dict[str, Any]]
    """Complete and check options given where they differ from the defaults; raises `BadInput`."""
    files: Callable[[dict[str, Any]], list[Path]]
    """Return the files and folders that a trial reads; their contents are part of its id."""
    rows: Callable[[dict[str, Any], BatchExecutor, Path], Iterator[list[TrialRow]]]
    """Yield the rows of every step as it ends; the folder is for the trial's own files."""
    columns: dict[str, type]
    """Columns of the rows."""
    fused: bool = False
    """Whether XLA may merge the kernels of its programs (`driftjax.environment.FUSED_RESULTS`)."""


@dataclass(frozen=True)
class Trial:
    """One combination of values, with all options of the verb."""

    id: str  # of options, contents of files, and the source that the work's functions depend on
    number: int  # in the design
    point: DesignPoint
    config: dict[str, Any]


@dataclass(frozen=True)
class Outcome:
    """Result of a trial."""

    trial: Trial
    status: Literal["done", "failed", "pruned"]
    error: str  # traceback of one that failed
    seconds: float
    rows: list[TrialRow]

    @property
    def sentence(self) -> str:
        """Return the last line of the error."""
        return " ".join((self.error.strip().splitlines() or [""])[-1].split())[:300]


def make_trial(work: Work, config: SweepConfig, number: int, point: DesignPoint) -> Trial:
    """Make the trial of a combination of values; raises `BadInput` where the verb cannot take it."""
    options = work.complete(config.base | {name: value for name, value in point.items() if "." not in name})
    for name, value in point.items():
        set_option(options, name, value)
    options = work.complete(options)
    return Trial(_id(work, config.verb, options), number, point, options)


def _id(work: Work, verb: str, config: dict[str, Any]) -> str:
    digest = hashlib.sha256(source_hash(*(f.__module__ for f in (work.rows, work.complete, work.files))))
    digest.update(json.dumps([verb, config], sort_keys=True).encode())
    for path in work.files(config):
        inside = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else []
        try:
            for file in inside or [path]:  # a ROS 2 bag is a folder
                digest.update(str(file.relative_to(path)).encode() + hashlib.sha256(file.read_bytes()).digest())
        except OSError as error:
            raise BadInput(f"{path}: cannot be read ({error.strerror}); check the path.") from None
    return digest.hexdigest()[:16]


def run_trial(
    work: Work, trial: Trial, executor: BatchExecutor, folder: Path, config: SweepConfig, watch: Watch | None
) -> Outcome:
    """Run a trial; an exception becomes part of its outcome and ends no other trial."""
    begun, rows = time.monotonic(), []
    try:
        for step, more in enumerate(work.rows(trial.config, executor, folder / trial.id)):
            rows += [row | {"step": step} for row in more]
            if watch is not None and watch(step, objective(rows, config.objective, config.stage)):
                return Outcome(trial, "pruned", "", time.monotonic() - begun, rows)
    except Exception:
        return Outcome(trial, "failed", traceback.format_exc(), time.monotonic() - begun, rows)
    return Outcome(trial, "done", "", time.monotonic() - begun, rows)


def objective(rows: list[TrialRow], figure: str, stage: str = "") -> float:
    """Return the mean of a figure over the rows of one stage (the last by default); NaN where a value is missing."""
    stages = [row.get("stage") for row in rows]
    wanted = stage or (stages[-1] if stages else "")
    values = [row.get(figure) for row, name in zip(rows, stages, strict=True) if name == wanted or name is None]
    numbers = [float(value) for value in values if isinstance(value, bool | int | float)]
    return math.fsum(numbers) / len(numbers) if numbers and len(numbers) == len(values) else math.nan
