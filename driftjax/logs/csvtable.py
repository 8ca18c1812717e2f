"""Read CSV files as loggers and spreadsheets write them: comments, lines of units, decimal commas, any encoding."""

import csv
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.cells import is_number, is_time
from driftjax.logs.table import Table, decode_text
from driftjax.logs.unit_words import parse_unit

DELIMITERS = (",", ";", "\t")
BINARY = re.compile(r"[\0-\x08\x0e-\x1a]")  # characters that no text has
DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+(e[+-]?\d+)?\s*", re.IGNORECASE)
OF_THOUSANDS = re.compile(r"\s*[+-]?[1-9]\d{0,2},\d{3}\s*")  # what a comma that separates thousands looks like too
NO_UNIT = frozenset({"", "-", "1", "[-]", "[1]"})  # how a line of units marks a column without a unit

CsvCells = list[str]


def csv_table(path: Path, content: bytes, skip: Callable[[int], bool]) -> Table:
    """Parse a CSV file; `skip` says which lines to skip."""
    text = decode_text(content)
    if BINARY.search(text):
        kinds = "Parquet, MATLAB, VBO, MoTeC, AiM, CarMaker, ROS bag, MCAP or MDF"
        raise BadInput(f"{path}: is neither text in UTF-8, UTF-16 or Latin-1 nor {kinds}; save it so.")
    lines, rows, comments = _rows(path, text, skip)
    names, units, first = _header(path, lines, _with_points(path, lines, rows), comments)
    lines, rows = lines[first:], _without_empty_ends(rows[first:], len(names))
    for line, cells in zip(lines, rows, strict=True):
        if len(cells) != len(names):
            raise BadInput(f"{path}, row {line}: has {len(cells)} cells for {len(names)} columns; correct the row.")
    if not units and len(rows) > 1 and are_units(rows[0], rows[1]):
        units, *rows = rows
        lines = lines[1:]
    stripped = lambda cells: tuple(cell.strip() for cell in cells)
    return Table(path, stripped(names), tuple(zip(*rows, strict=True)), np.array(lines, int), stripped(units))


def are_units(cells: Sequence[str], below: Sequence[str]) -> bool:
    """Return whether a row holds units: words above numbers, of which one is a unit where others are 1."""
    if not any(map(is_number, cells)):
        return any(map(is_number, below))
    over_numbers = [cell for cell, number in zip(cells, below, strict=False) if is_number(number)]
    if any(is_number(cell) and cell.strip() not in NO_UNIT for cell in cells):
        return False
    return any(parse_unit(cell) is not None for cell in over_numbers)


def _rows(path: Path, text: str, skip: Callable[[int], bool]) -> tuple[list[int], list[CsvCells], list[CsvCells]]:
    """Return line and cells of each row, and the comments before the first."""
    lines, rows, comments = [], [], []
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=_delimiter(text, skip))
    try:
        for cells in reader:
            if skip(reader.line_num) or not any(cell.strip() for cell in cells):
                continue
            if not cells[0].lstrip().startswith("#"):
                lines.append(reader.line_num)
                rows.append(cells)
            elif not rows:
                comments.append([_without_quotes(cells[0].lstrip().lstrip("#").strip()), *cells[1:]])
    except csv.Error as error:
        raise BadInput(f"{path}, row {reader.line_num}: is no CSV ({error}); correct the row.") from None
    if not rows:
        raise BadInput(f"{path}: is empty; give a log with a row of names and rows of numbers.")
    return lines, rows, comments


def _header(
    path: Path, lines: list[int], rows: list[CsvCells], comments: list[CsvCells]
) -> tuple[CsvCells, CsvCells, int]:
    """Return names, units (empty if the comments have none) and the number of the first row below the names.

    The names may be the last comment before numbers or units in which no cell is there twice, as those of groups are.
    """
    first = rows[0]
    widths = {len(first), len(first) - (not first[-1].strip())}
    fitting = [cells for cells in comments if len(cells) in widths]
    if fitting and (any(map(_is_value, first)) or (_mostly_units(first) and not _mostly_units(fitting[-1]))):
        words = [cells for cells in fitting if not _mostly_units(cells)]
        names = next((cells for cells in reversed(words) if len(set(cells)) == len(cells)), (words or fitting)[-1])
        units = fitting[-1] if fitting[-1] is not names and _mostly_units(fitting[-1]) else []
        return names, units if len(units) == len(names) else [], 0
    if all(map(_is_value, first)):
        raise BadInput(f"{path}, row {lines[0]}: holds numbers where the names of the columns should be; write a row "
                       "of names above it.")  # fmt: skip
    return first, [], 1


def _is_value(cell: str) -> bool:
    """Return whether a cell holds what is measured: a finite number or a time."""
    return is_number(cell) or is_time(cell)


def _without_quotes(cell: str) -> str:
    return cell[1:-1] if len(cell) > 1 and cell[0] == cell[-1] == '"' else cell


def _mostly_units(cells: CsvCells) -> bool:
    """Return whether most cells are units, of those that do not mark a column without one."""
    stated = [cell for cell in cells if cell.strip() not in NO_UNIT]
    return sum(parse_unit(cell) is not None for cell in stated) > len(stated) / 2


def _without_empty_ends(rows: list[CsvCells], width: int) -> list[CsvCells]:
    """Return the rows without the empty cell that a delimiter at the end of all of them makes."""
    longer = [len(cells) == width + 1 and not cells[-1].strip() for cells in rows]
    return [cells[:width] for cells in rows] if rows and all(longer[1:]) and any(longer) else rows


def _with_points(path: Path, lines: list[int], rows: list[CsvCells]) -> list[CsvCells]:
    """Return the rows, changed in place, with decimal commas as points, if no cell has a decimal point.

    Raises `BadInput` if all commas may as well separate thousands.
    """
    commas = [(i, k) for i, cells in enumerate(rows) for k, cell in enumerate(cells)
              if "," in cell and DECIMAL_COMMA.fullmatch(cell)]  # fmt: skip
    if not commas or any("." in cell and is_number(cell) for cells in rows for cell in cells):
        return rows
    if all(OF_THOUSANDS.fullmatch(rows[i][k]) for i, k in commas):
        i, k = commas[0]
        raise BadInput(f"{path}, row {lines[i]}: holds '{rows[i][k].strip()}', whose comma may be a decimal comma or "
                       "separate thousands; write all numbers with decimal points.")  # fmt: skip
    for i, k in commas:
        rows[i][k] = rows[i][k].replace(",", ".")
    return rows


def _delimiter(text: str, skip: Callable[[int], bool]) -> str:
    """Return the delimiter that occurs most in the first row, if it is not one of numbers with decimal commas."""
    for number, line in enumerate(io.StringIO(text), start=1):
        if line.strip() and not skip(number) and not line.lstrip().startswith("#"):
            for one in DELIMITERS[1:]:
                if one in line and all(is_number(cell.replace(",", ".")) for cell in line.split(one) if cell.strip()):
                    return one
            return max(DELIMITERS, key=line.count)
    return DELIMITERS[0]
