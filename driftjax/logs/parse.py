"""Parse CSV, Parquet, MATLAB and VBO files to tables."""

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.matfile import mat_columns
from driftjax.logs.table import MISSING, Table
from driftjax.logs.vbo import is_vbo, vbo_table

DELIMITERS = (",", ";", "\t")


def parse_table(path: Path, content: bytes, skip: Callable[[int], bool], time: str | None = None) -> Table:
    """Parse a CSV, Parquet, MATLAB or VBO file to a table.

    `skip` says which lines of a CSV to skip, `time` which vector of a MATLAB file gives the length.
    """
    if content.startswith(b"PAR1"):
        table = _parquet(path, content)
    elif content.startswith(b"MATLAB"):
        columns = mat_columns(path, content, time)
        table = Table(
            path, tuple(columns), tuple(columns.values()), np.arange(1, len(next(iter(columns.values()))) + 1)
        )
    elif is_vbo(content):
        table = vbo_table(path, content)
    else:
        table = _csv(path, content, skip)
    if not table.lines.size:
        raise BadInput(f"{path}: holds names of columns but no rows; give a log with rows of numbers.")
    return table


def _csv(path: Path, content: bytes, skip: Callable[[int], bool]) -> Table:
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        kinds = "Parquet, MATLAB, VBO, MoTeC, AiM, CarMaker, ROS bag, MCAP or MDF"
        raise BadInput(f"{path}: is neither text in UTF-8 nor {kinds}; save it so.") from None
    names, lines, rows = _header_and_rows(path, text, skip)
    for line, cells in zip(lines, rows, strict=True):
        if len(cells) != len(names):
            raise BadInput(f"{path}, row {line}: has {len(cells)} cells for {len(names)} columns; correct the row.")
    units: list[str] = []
    if len(rows) > 1 and not any(map(is_number, rows[0])) and any(map(is_number, rows[1])):
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
    if len(comment) == len(rows[0]) and any(map(is_number, rows[0])):
        return [comment[0].lstrip().lstrip("#"), *comment[1:]], lines, rows
    if all(map(is_number, rows[0])):
        raise BadInput(f"{path}, row {lines[0]}: holds numbers where the names of the columns should be; write a row "
                       "of names above it.")  # fmt: skip
    return rows[0], lines[1:], rows[1:]


def is_number(cell: str) -> bool:
    """Return whether a cell holds a finite number."""
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
