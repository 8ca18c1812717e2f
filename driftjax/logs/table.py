"""Tables of measured values: named columns, each row with its line in the file."""

import codecs
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import compress
from pathlib import Path

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.cells import cells_as_numbers
from driftjax.logs.extras import printable
from driftjax.logs.series import similar_names


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of one log: cells of a CSV as text, numeric columns of a Parquet file or a recording as arrays."""

    path: Path
    names: tuple[str, ...]
    columns: tuple[Sequence[str] | np.ndarray, ...]
    lines: np.ndarray
    """Where each row stands: line of the CSV, header included, row of the Parquet file or sample; from 1."""
    units: tuple[str, ...] = ()
    """What the file says of the unit of each column; empty where it says nothing of any."""

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def select_rows(self, mask: np.ndarray) -> "Table":
        """Return the rows where `mask` is true."""
        columns = (c[mask] if isinstance(c, np.ndarray) else list(compress(c, mask)) for c in self.columns)
        return Table(self.path, self.names, tuple(columns), self.lines[mask], self.units)

    def numbers(self, name: str) -> np.ndarray:
        """Return column `name` as floats, NaN where a value is missing, times of day in seconds.

        Raises `BadInput` that names the row.
        """
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
        values, wrong = cells_as_numbers(cells)
        if wrong:
            cell = cells[wrong[0]].strip()
            raise BadInput(
                f"{self.path}, row {self.lines[wrong[0]]}: column '{name}' holds '{printable(cell)}', "
                f"not a number{' with a decimal point' * (',' in cell)}; "
                "correct it, or leave the cell empty where the value is missing."
            )
        return values


def decode_text(content: bytes) -> str:
    """Return the bytes of a file as text: UTF-16 with its mark, UTF-8, or else Latin-1, which reads any bytes."""
    for encoding in ("utf-16",) * content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) + ("utf-8-sig",):
        try:
            return content.decode(encoding)
        except UnicodeDecodeError:
            continue
    return content.decode("latin-1")


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
