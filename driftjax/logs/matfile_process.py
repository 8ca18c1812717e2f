"""Reader of MATLAB files of version 5 for `driftjax.logs.reader_process`: SciPy crashes on some damaged ones."""

import io
import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

EntryPath = tuple[str | int, ...]  # names of fields, and numbers of entries of cells and arrays of structs


def read_arrays(_path: str, content: bytes) -> dict[str, np.ndarray]:
    """Return the numeric arrays of a file, `value0` and so on, and their `places` as JSON."""
    import scipy.io

    variables = scipy.io.loadmat(io.BytesIO(content), simplify_cells=True)
    found = [one for name, value in variables.items() if not name.startswith("__")
             for one in leaves((name,), value, lambda value: value)]  # fmt: skip
    places = np.array(json.dumps([place for place, _ in found]))
    return {"places": places} | {f"value{k}": value for k, (_, value) in enumerate(found)}


def leaves(place: EntryPath, value: Any, opened: Callable[[Any], Any]) -> Iterator[tuple[EntryPath, np.ndarray]]:
    """Yield the numeric arrays below `value`, which is at `place`, with their paths."""
    while (inner := opened(value)) is not value:
        value = inner
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from leaves((*place, key), entry, opened)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object and value.ndim):
        for number, entry in enumerate(np.ravel(np.asarray(value, object))):
            yield from leaves((*place, number), entry, opened)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        yield place, value
