"""Tables of measured values: CSV and Parquet as named columns, each row with its line in the file."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.matfile import mat_columns
from driftjax.logs.series import similar_names

MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})  # cells that hold no value, in lower case
DELIMITERS = (",", ";", "\t")


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of one log: cells of a CSV as text, numeric columns of a Parquet file or a recording as arrays."""

    path: Path
    names: tuple[str, ...]
    columns: tuple[Sequence[str] | np.ndarray, ...]
    lines: np.ndarray
    """Where each row stands: line of the CSV, header included, row of the Parquet file or sample; from 1."""
    units: tuple[str, ...] = ()
    """What a line of units below the header of a CSV says of each column; empty without one."""

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def select_rows(self, mask: np.ndarray) -> "Table":
        """Return the rows where `mask` is true."""
        columns = (c[mask] if isinstance(c, np.ndarray) else list(compress(c, mask)) for c in self.columns)
        return Table(self.path, self.names, tuple(columns), self.lines[mask], self.units)

    def numbers(self, name: str) -> np.ndarray:
        """Return column `name` as floats, NaN where a value is missing; raises `BadInput` that names the row."""
        column = self._column(name)
        values = column if isinstance(column, np.ndarray) else self._parse(name, column)
        if np.isinf(values).any():
            line = self.lines[np.argmax(np.isinf(values))]
            raise BadInput(f"{self.path}, row {line}: column '{name}' is infinite; leave the cell empty instead.")
        return values

    def words(self, name: str) -> list[str]:
        """Return column `name` as text; whole numbers without a decimal point."""
        column = self._column(name)
        if isinstance(column, np.ndarray):
            return ["" if np.isnan(value) else f"{value:.15g}" for value in column]
        return [cell.strip() for cell in column]

    def _column(self, name: str) -> Sequence[str] | np.ndarray:
        if name not in self.names:
            there = similar_names(name, self.names)
            raise BadInput(
                f"{self.path}: column '{name}' is missing; add it or correct the column map. There are {there}."
            )
        if self.names.count(name) > 1:
            raise BadInput(f"{self.path}: column '{name}' is there {self.names.count(name)} times; leave one.")
        return self.columns[self.names.index(name)]

    def _parse(self, name: str, cells: Sequence[str]) -> np.ndarray:
        values = np.empty(len(cells))
        for i, cell in enumerate(cells):
            try:
                values[i] = float(cell) if cell else np.nan
            except ValueError:
                if cell.strip().lower() not in MISSING:
                    raise BadInput(
                        f"{self.path}, row {self.lines[i]}: column '{name}' holds '{cell.strip()}', not a number; "
                        "correct it, or leave the cell empty where the value is missing."
                    ) from None
                values[i] = np.nan
        return values


@contextmanager
def file_errors(path: Path) -> Iterator[None]:
    """Raise `BadInput` if the file cannot be read."""
    try:
        yield
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file; check the path.") from None
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}); check the file and its permissions.") from None


def read_bytes(path: Path) -> bytes:
    """Return the bytes of the file; raises `BadInput` if it cannot be read or is empty."""
    with file_errors(path):
        content = path.read_bytes()
    if not content.strip():
        raise BadInput(f"{path}: is empty; give a log with a row of names and rows of numbers.")
    return content


def parse_table(path: Path, content: bytes, skip: Callable[[int], bool], time: str | None = None) -> Table:
    """Parse a CSV, Parquet or MATLAB file to a table.

    `skip` says which lines of a CSV to skip, `time` which vector of a MATLAB file gives the length.
    """
    if content.startswith(b"PAR1"):
        table = _parquet(path, content)
    elif content.startswith(b"MATLAB"):
        columns = mat_columns(path, content, time)
        table = Table(
            path, tuple(columns), tuple(columns.values()), np.arange(1, len(next(iter(columns.values()))) + 1)
        )
    else:
        table = _csv(path, content, skip)
    if not table.lines.size:
        raise BadInput(f"{path}: holds names of columns but no rows; give a log with rows of numbers.")
    return table


def _csv(path: Path, content: bytes, skip: Callable[[int], bool]) -> Table:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        kinds = "Parquet, MATLAB, ROS bag, MCAP or MDF"
        raise BadInput(f"{path}: is neither text in UTF-8 nor {kinds}; save it so.") from None
    names, lines, rows = _header_and_rows(path, text, skip)
    for line, cells in zip(lines, rows, strict=True):
        if len(cells) != len(names):
            raise BadInput(f"{path}, row {line}: has {len(cells)} cells for {len(names)} columns; correct the row.")
    units: list[str] = []
    if len(rows) > 1 and not any(map(_is_number, rows[0])) and any(map(_is_number, rows[1])):
        units, *rows = rows
        lines = lines[1:]
    stripped = lambda cells: tuple(cell.strip() for cell in cells)
    return Table(path, stripped(names), tuple(zip(*rows, strict=True)), np.array(lines, int), stripped(units))


def _header_and_rows(path: Path, text: str, skip: Callable[[int], bool]) -> tuple[list[str], list[int], list[list]]:
    """Return the names, and line and cells of each row; the header may be the last comment before numbers."""
    lines, rows, comment = [], [], []
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=_delimiter(text, skip))
    try:
        for cells in reader:
            if skip(reader.line_num) or not any(cell.strip() for cell in cells):
                continue
            if cells[0].lstrip().startswith("#"):
                comment = comment if rows else cells
            else:
                lines.append(reader.line_num)
                rows.append(cells)
    except csv.Error as error:
        raise BadInput(f"{path}, row {reader.line_num}: is no CSV ({error}); correct the row.") from None
    if not rows:
        raise BadInput(f"{path}: is empty; give a log with a row of names and rows of numbers.")
    if len(comment) == len(rows[0]) and any(map(_is_number, rows[0])):
        return [comment[0].lstrip().lstrip("#"), *comment[1:]], lines, rows
    return rows[0], lines[1:], rows[1:]


def _is_number(cell: str) -> bool:
    try:
        return cell.strip().lower() not in MISSING and np.isfinite(float(cell))
    except ValueError:
        return False


def _delimiter(text: str, skip: Callable[[int], bool]) -> str:
    """Return the delimiter that occurs most in the header row."""
    for number, line in enumerate(io.StringIO(text), start=1):
        if line.strip() and not skip(number) and not line.lstrip().startswith("#"):
            return max(DELIMITERS, key=line.count)
    return DELIMITERS[0]


def _parquet(path: Path, content: bytes) -> Table:
    import pyarrow.parquet

    def column(values: Any) -> Sequence[str] | np.ndarray:
        kinds = (pyarrow.types.is_floating, pyarrow.types.is_integer, pyarrow.types.is_boolean)
        if any(is_kind(values.type) for is_kind in kinds):
            return np.array([np.nan if value is None else value for value in values.to_pylist()], float)
        return ["" if value is None else str(value) for value in values.to_pylist()]

    try:
        table = pyarrow.parquet.read_table(io.BytesIO(content))
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: is no readable Parquet file ({error}); write it again.") from None
    columns = tuple(map(column, table.columns))
    return Table(path, tuple(table.column_names), columns, np.arange(1, table.num_rows + 1))
