"""Raw runs of a log: rows mapped to channels, filtered and separated."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.columns import RUN, ColumnMap, map_channels, standard_columns
from driftjax.logs.table import Table


@dataclass(frozen=True, eq=False)
class RawRun:
    """One run as stored in its file."""

    path: Path
    name: str
    lines: np.ndarray
    """Row of each sample in the file."""
    values: dict[str, np.ndarray]
    """Channels, `t` among them; NaN where a value is missing."""
    labels: dict[str, str]
    """What messages call each channel."""
    beta_mapped: bool
    """Whether beta is a column of its own, not the direction of vx, vy."""

    @property
    def where(self) -> str:
        """Return file and run, for messages."""
        return f"{self.path}, run '{self.name}'"

    def select_rows(self, rows: np.ndarray | slice) -> "RawRun":
        """Return the run with some of the rows."""
        return replace(self, lines=self.lines[rows], values={name: y[rows] for name, y in self.values.items()})

    def with_channels(self, **values: np.ndarray) -> "RawRun":
        """Return the run with new values of some channels."""
        return replace(self, values=self.values | values)

    def reject(self, name: str, bad: np.ndarray, unit: str, remedy: str) -> None:
        """Raise `BadInput` at the first row where `bad` is true for channel `name`."""
        if np.any(bad):
            i = int(np.argmax(bad))
            what = f"{self.labels[name]} is {self.values[name][i]:g} {unit}"
            raise BadInput(f"{self.path}, row {self.lines[i]}: {what}; {remedy}.")


def raw_runs(table: Table, columns: ColumnMap | None, notes: list[str]) -> list[RawRun]:
    """Return the runs of one log, in order of their first rows; omissions are appended to `notes`."""
    path = table.path
    if columns is None:
        columns = standard_columns(table)
        known = (*(channel.name for channel in columns.columns), RUN)
        if ignored := [f"'{name}'" for name in table.names if name not in known]:
            notes.append(f"{path}: columns that the log format does not have were left out: {', '.join(ignored)}.")
    elif columns.Fxr_from:
        verb = "stand" if len(columns.Fxr_from) > 1 else "stands"
        notes.append(f"{path}: {columns.force_columns} {verb} for Fxr, as the column map says.")
    table = _filtered(table, columns, notes)
    if columns.position_from is not None:
        north, east = columns.position_from.start(table)
        notes.append(f"{path}: x is metres east and y metres north of latitude {north:.7f}, longitude {east:.7f} deg.")
    values, labels = map_channels(table, columns), columns.labels()
    beta_mapped = any(channel.name == "beta" for channel in columns.columns)
    return [
        RawRun(path, name, table.lines[rows], {key: y[rows] for key, y in values.items()}, labels, beta_mapped)
        for name, rows in _rows_of_runs(table, columns.run).items()
    ]


def _filtered(table: Table, columns: ColumnMap, notes: list[str]) -> Table:
    passes = np.ones(len(table.lines), bool)
    for condition in columns.where:
        passes &= condition.matches(table)
        if not passes.any():
            raise BadInput(
                f"{table.path}: no row passes the condition on '{condition.column}'; correct the column map."
            )
    if not passes.all():
        notes.append(f"{table.path}: conditions of the column map left out {np.sum(~passes)} of {passes.size} rows.")
    return table.select_rows(passes)


def _rows_of_runs(table: Table, columns: tuple[str, ...]) -> dict[str, np.ndarray]:
    if not columns:
        return {table.path.stem: np.arange(len(table.lines))}
    rows: dict[str, list[int]] = {}
    for i, words in enumerate(zip(*map(table.words, columns), strict=True)):
        if not all(words):
            empty = columns[words.index("")]
            raise BadInput(f"{table.path}, row {table.lines[i]}: column '{empty}' is empty; name the run there.")
        rows.setdefault("/".join(words), []).append(i)
    return {name: np.array(index) for name, index in rows.items()}
