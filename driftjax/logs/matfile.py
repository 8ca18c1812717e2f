"""Read MATLAB files (version 5 with SciPy, 7.3 with h5py): vectors of nested structs and cells by their dotted path."""

import io
import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from driftjax.core import BadInput
from driftjax.logs.columns import RUN
from driftjax.logs.extras import library_errors
from driftjax.logs.isolated import read_isolated
from driftjax.logs.matfile_process import EntryPath, leaves

KIND = "MATLAB file"
REMEDY = "save it again, with `save(name, '-v7')` or '-v7.3'"
MOST_BYTES = 4 * 2**30  # of all arrays of a file together
MOST_COLUMNS = 64  # of a matrix; a wider one is no table of channels

SCRIPT = Path(__file__).with_name("matfile_process.py")


def mat_columns(path: Path, content: bytes, time: str | None) -> dict[str, np.ndarray]:
    """Return the numeric vectors of a MATLAB file, all of one length, by their path: `car.imu.r`, `runs.0.t`.

    Column k of a matrix is `name.k`, entry k of a cell or of an array of structs too, counted from 0. Where entries are
    runs, `name` holds all of them and `run` the number of the entry (see `_stacked`). The length is that of the vector
    called `time`, or where there is none the one that most vectors have.
    """
    columns: dict[str, np.ndarray] = {}
    entries: dict[str, dict[int, np.ndarray]] = defaultdict(dict)
    with library_errors(path, KIND, REMEDY):
        for place, value in _version_5(path, content) if _is_version_5(content) else _version_7_3(path, content):
            found = _columns(".".join(map(str, place)), value)
            columns |= found
            numbers = [key for key in place if isinstance(key, int)]
            if len(numbers) == 1 and len(found) == 1:
                entries[".".join(str(key) for key in place if isinstance(key, str))][numbers[0]] = value
    columns = _stacked(entries) | columns
    if not columns:
        raise BadInput(f"{path}: holds no numeric vector; save structs and arrays, not objects such as timetables.")
    size = len(columns[time]) if time in columns else Counter(map(len, columns.values())).most_common(1)[0][0]
    return {name: values for name, values in columns.items() if len(values) == size}


def _stacked(entries: dict[str, dict[int, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the entries of cells and arrays of structs one after the other, with the column `run`.

    They are runs where at least two names have entries 0.. of the same lengths, the most names where there are
    several such groups; else nothing is returned.
    """
    groups: dict[tuple[int, ...], list[str]] = defaultdict(list)
    for name, values in entries.items():
        if len(values) > 1 and set(values) == set(range(len(values))):
            groups[tuple(values[k].size for k in range(len(values)))].append(name)
    sizes = max(groups, key=lambda one: len(groups[one]), default=())
    if len(groups[sizes]) < 2:
        return {}
    numbers = range(len(sizes))
    whole = {name: np.concatenate([np.ravel(entries[name][k]) for k in numbers]) for name in groups[sizes]}
    return {name: values.astype(float) for name, values in whole.items()} | {
        RUN: np.repeat(np.array(numbers, float), sizes)
    }


def _is_version_5(content: bytes) -> bool:
    return content.startswith(b"MATLAB 5.0")


def _version_5(path: Path, content: bytes) -> Iterator[tuple[EntryPath, np.ndarray]]:
    arrays = read_isolated(SCRIPT, path, KIND, REMEDY, content)
    for k, place in enumerate(json.loads(str(arrays["places"]))):
        yield tuple(place), arrays[f"value{k}"]


def _version_7_3(path: Path, content: bytes) -> Iterator[tuple[EntryPath, np.ndarray]]:
    with h5py.File(io.BytesIO(content)) as file:
        size = 0

        def opened(value: Any) -> Any:
            """Return a group as a dict, a cell as its entries, an array in MATLAB's order of axes."""
            nonlocal size
            if isinstance(value, h5py.Reference):
                return file[value]
            if isinstance(value, h5py.Group):
                _require_inside(
                    path, any(isinstance(value.get(name, getlink=True), h5py.ExternalLink) for name in value)
                )
                return dict(value)
            if isinstance(value, h5py.Dataset):
                is_text = value.attrs.get("MATLAB_class") in (b"char", "char")
                if is_text or "MATLAB_empty" in value.attrs:
                    return ""
                _require_inside(path, value.is_virtual or bool(value.external))
                size += value.nbytes
                if size > MOST_BYTES:
                    raise BadInput(f"{path}: describes over {MOST_BYTES / 2**30:g} GiB of arrays; leave out what is no "
                                   "channel.")  # fmt: skip
                return np.squeeze(value[()].T)
            return value

        for name, value in opened(file).items():
            if not name.startswith("#"):  # where cells are stored
                yield from leaves((name,), value, opened)


def _require_inside(path: Path, outside: bool) -> None:
    if outside:
        raise BadInput(f"{path}: takes data from other files (external link, external storage or virtual dataset), "
                       "which is not read; save the data in the file itself.")  # fmt: skip


def _columns(name: str, value: np.ndarray) -> dict[str, np.ndarray]:
    """Return a vector, or the columns of a matrix; nothing for a single number or an array of more axes."""
    value = np.squeeze(value).astype(float)
    if value.ndim == 1 and value.size > 1:
        return {name: value}
    if value.ndim == 2 and value.shape[1] <= MOST_COLUMNS:
        return {f"{name}.{k}": column for k, column in enumerate(value.T)}
    return {}
