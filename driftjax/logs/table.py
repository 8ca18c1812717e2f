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

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def select_rows(self, mask: np.ndarray) -> "Table":
        """Return the rows where `mask` is true."""
        columns = (c[mask] if isinstance(c, np.ndarray) else list(compress(c, mask)) for c in self.columns)
        return Table(self.path, self.names, tuple(columns), self.lines[mask])

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
            raise BadInput(f"{self.path}: column '{name}' is missing; add it or correct the column map.")
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


def parse_table(path: Path, content: bytes, skip: Callable[[int], bool]) -> Table:
    """Parse a CSV or Parquet file to a table; `skip` says which lines of a CSV to skip."""
    table = _parquet(path, content) if content.startswith(b"PAR1") else _csv(path, content, skip)
    if not table.lines.size:
        raise BadInput(f"{path}: holds names of columns but no rows; give a log with rows of numbers.")
    return table


def _csv(path: Path, content: bytes, skip: Callable[[int], bool]) -> Table:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise BadInput(f"{path}: is neither text in UTF-8 nor Parquet, ROS bag, MCAP or MDF; save it so.") from None
    lines, rows = [], []
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=_delimiter(text, skip))
    try:
        for cells in reader:
            if not skip(reader.line_num) and not _is_blank(cells):
                lines.append(reader.line_num)
                rows.append(cells)
    except csv.Error as error:
        raise BadInput(f"{path}, row {reader.line_num}: is no CSV ({error}); correct the row.") from None
    if not rows:
        raise BadInput(f"{path}: is empty; give a log with a row of names and rows of numbers.")
    names, *rows = rows
    for line, cells in zip(lines[1:], rows, strict=True):
        if len(cells) != len(names):
            raise BadInput(f"{path}, row {line}: has {len(cells)} cells for {len(names)} columns; correct the row.")
    return Table(path, tuple(name.strip() for name in names), tuple(zip(*rows, strict=True)), np.array(lines[1:], int))


def _is_blank(cells: list[str]) -> bool:
    return not any(cell.strip() for cell in cells) or cells[0].lstrip().startswith("#")


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
