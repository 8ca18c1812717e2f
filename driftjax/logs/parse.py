"""Parse CSV, Parquet, MATLAB and VBO files to tables."""

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.csvtable import csv_table
from driftjax.logs.extras import library_errors
from driftjax.logs.matfile import mat_columns
from driftjax.logs.table import Table
from driftjax.logs.vbo import is_vbo, vbo_table


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
        table = csv_table(path, content, skip)
    if not table.lines.size:
        raise BadInput(f"{path}: holds names of columns but no rows; give a log with rows of numbers.")
    return table


def _parquet(path: Path, content: bytes) -> Table:
    import pyarrow.parquet

    def column(values: Any) -> Sequence[str] | np.ndarray:
        kinds = (pyarrow.types.is_floating, pyarrow.types.is_integer, pyarrow.types.is_boolean)
        if any(is_kind(values.type) for is_kind in kinds):
            return np.array([np.nan if value is None else value for value in values.to_pylist()], float)
        return ["" if value is None else str(value) for value in values.to_pylist()]

    with library_errors(path, "Parquet file", "write it again"):
        table = pyarrow.parquet.read_table(io.BytesIO(content))
        columns = tuple(map(column, table.columns))
    return Table(path, tuple(table.column_names), columns, np.arange(1, table.num_rows + 1))
