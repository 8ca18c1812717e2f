"""Store outcomes: a folder of Parquet files, each complete or absent, every trial in exactly one of them."""

import fcntl
import json
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from driftjax.core import BadInput, write_atomically
from driftjax.sweep.config import Field, Range, SweepConfig
from driftjax.sweep.trial import Outcome, Work

PARTS, DAMAGED, ERRORS, LOCK = "trials", "damaged", "errors", "lock"
TYPES = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}
FIRST = {"trial": str, "number": int, "status": str, "seconds": float, "error": str, "config": str, "step": int}


class Store:
    """The outcomes of one sweep on disk; one process at a time writes them."""

    def __init__(self, path: Path, config: SweepConfig, work: Work):
        self.path, self.work = path, work
        fields = {name: _type(values) for name, values in config.varied.items()}
        if both := sorted(set(fields) & (set(FIRST) | set(work.columns))):
            raise BadInput(f"key 'fields.{both[0]}': results have a column of this name; vary another field.")
        kinds = FIRST | fields | work.columns
        self.schema = pa.schema([pa.field(name, TYPES[kind]) for name, kind in kinds.items()])

    @contextmanager
    def locked(self, process: int = 0) -> Iterator[None]:
        """Lock the folder, or the share of this `process` of several; raises `BadInput` if another sweep has locked it.

        A killed sweep leaves no lock.
        """
        try:
            handle = (self.path / f"{LOCK}{process}").open("a")
        except OSError as error:
            raise BadInput(f"{self.path}: cannot be written ({error.strerror}); give another folder (--out).") from None
        with handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BadInput(
                    f"{self.path}: another sweep is writing here; wait for it, or give another folder (--out)."
                ) from None
            yield

    def parts(self) -> list[Path]:
        """Return the Parquet files."""
        return sorted((self.path / PARTS).glob("*.parquet"))

    def known_trials(self) -> tuple[set[str], list[Path]]:
        """Return the ids of the stored trials, and the files set aside because they cannot be read."""
        ids: set[str] = set()
        damaged = []
        for path in self.parts():
            try:
                trials = pq.read_table(path, columns=["trial"]).column("trial").to_pylist()
            except (pa.ArrowException, OSError):
                aside = self.path / DAMAGED / path.name
                aside.parent.mkdir(exist_ok=True)
                os.replace(path, aside)
                damaged.append(aside)
                continue
            ids |= set(trials)
        return ids, damaged

    def add(self, outcomes: list[Outcome]) -> Path:
        """Write one more file with these outcomes; a trial without rows gets one row of its own values."""
        rows = [row for outcome in outcomes for row in _rows(outcome)]
        columns = {name: [row.get(name) for row in rows] for name in self.schema.names}
        table = pa.table(columns, schema=self.schema)
        (self.path / PARTS).mkdir(exist_ok=True)
        for outcome in (one for one in outcomes if one.error):
            (self.path / ERRORS).mkdir(exist_ok=True)
            write = lambda p, text=outcome.error: p.write_text(text)
            write_atomically(self.path / ERRORS / f"{outcome.trial.id}.txt", write)
        path = self.path / PARTS / f"{outcomes[0].trial.number:08d}-{uuid.uuid4().hex[:8]}.parquet"
        write_atomically(path, lambda p: pq.write_table(table, p, compression="zstd"))
        return path


def _type(values: Field) -> type:
    """Return the type of a field's column."""
    if isinstance(values, Range):
        return int if values.integer else float
    kinds = {type(value) for value in values.values if value is not None}
    return kinds.pop() if len(kinds) == 1 else str


def _rows(outcome: Outcome) -> list[dict]:
    trial = outcome.trial
    first = {
        "trial": trial.id, "number": trial.number, "status": outcome.status, "seconds": outcome.seconds,
        "error": outcome.sentence, "config": json.dumps(trial.config, sort_keys=True),
    }  # fmt: skip
    return [first | trial.point | row for row in outcome.rows or [{}]]
