"""Read MATLAB files (version 5 with SciPy, 7.3 with h5py): vectors of nested structs and cells by their dotted path."""

import io
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from driftjax.core import BadInput
from driftjax.logs.extras import library_errors

KIND = "MATLAB file"
REMEDY = "save it again, with `save(name, '-v7')` or '-v7.3'"
MOST_COLUMNS = 64  # of a matrix; a wider one is no table of channels


def mat_columns(path: Path, content: bytes, time: str | None) -> dict[str, np.ndarray]:
    """Return the numeric vectors of a MATLAB file, all of one length, by their path: `car.imu.r`, `runs.0.t`.

    Column k of a matrix is `name.k`, entry k of a cell or of an array of structs too, counted from 0. The length is
    that of the vector called `time`, or where there is none the one that most vectors have.
    """
    columns: dict[str, np.ndarray] = {}
    with library_errors(path, KIND, REMEDY):
        for name, value in _version_5(content) if _is_version_5(content) else _version_7_3(content):
            columns |= _columns(name, value)
    if not columns:
        raise BadInput(f"{path}: holds no numeric vector; save structs and arrays, not objects such as timetables.")
    size = len(columns[time]) if time in columns else Counter(map(len, columns.values())).most_common(1)[0][0]
    return {name: values for name, values in columns.items() if len(values) == size}


def _is_version_5(content: bytes) -> bool:
    return content.startswith(b"MATLAB 5.0")


def _version_5(content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    import scipy.io

    variables = scipy.io.loadmat(io.BytesIO(content), simplify_cells=True)
    for name, value in variables.items():
        if not name.startswith("__"):
            yield from _leaves(name, value, lambda value: value)


def _version_7_3(content: bytes) -> Iterator[tuple[str, np.ndarray]]:
    with h5py.File(io.BytesIO(content)) as file:

        def opened(value: Any) -> Any:
            """Return a group as a dict, a cell as its entries, an array in MATLAB's order of axes."""
            if isinstance(value, h5py.Reference):
                return file[value]
            if isinstance(value, h5py.Group):
                return dict(value)
            if isinstance(value, h5py.Dataset):
                is_text = value.attrs.get("MATLAB_class") in (b"char", "char")
                return "" if is_text or "MATLAB_empty" in value.attrs else np.squeeze(value[()].T)
            return value

        for name, value in file.items():
            if not name.startswith("#"):  # where cells are stored
                yield from _leaves(name, value, opened)


def _leaves(name: str, value: Any, opened: Callable[[Any], Any]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the numeric arrays below `value` with their paths."""
    while (inner := opened(value)) is not value:
        value = inner
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from _leaves(f"{name}.{key}", entry, opened)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object and value.ndim):
        for number, entry in enumerate(np.ravel(np.asarray(value, object))):
            yield from _leaves(f"{name}.{number}", entry, opened)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        yield name, value


def _columns(name: str, value: np.ndarray) -> dict[str, np.ndarray]:
    """Return a vector, or the columns of a matrix; nothing for a single number or an array of more axes."""
    value = np.squeeze(value).astype(float)
    if value.ndim == 1 and value.size > 1:
        return {name: value}
    if value.ndim == 2 and value.shape[1] <= MOST_COLUMNS:
        return {f"{name}.{k}": column for k, column in enumerate(value.T)}
    return {}
