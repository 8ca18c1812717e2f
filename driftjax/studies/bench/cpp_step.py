"""Step of the single track in C++ (`single_track.cpp`), compiled by g++ on request."""

import ctypes
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from driftjax.vehicle import VehicleConfig

SOURCE = Path(__file__).with_name("single_track.cpp")
FLAGS = {
    "vector": ["-O3", "-march=native", "-ffast-math", "-fopenmp-simd", "-fopt-info-vec"],
    "scalar": ["-O3", "-march=native", "-fno-tree-vectorize"],
}


PARAMETERS = ("m", "Iz", "a", "b", "mu", "B", "C")


class _Car(ctypes.Structure):
    _fields_ = [(name, ctypes.c_double) for name in PARAMETERS]


@dataclass(frozen=True)
class Library:
    """Compiled steps."""

    loaded: ctypes.CDLL
    vectorised: bool  # whether g++ says that it vectorised the loop, its sines and arc tangents included


def compiled(kind: Literal["vector", "scalar"]) -> Library:
    """Compile the steps by g++; `vector` allows reordered sums and all instructions of this processor.

    It is linked by a command of its own: linking with `-ffast-math` adds a start-up routine that makes the thread
    which loads the library flush denormal numbers to zero from then on, NumPy's included.
    """
    with tempfile.TemporaryDirectory(prefix="driftjax-bench-") as folder:
        library, part = (str(Path(folder) / f"{kind}{end}") for end in (".so", ".o"))
        command = ["g++", *FLAGS[kind], "-fPIC", "-c", str(SOURCE), "-o", part]
        messages = subprocess.run(command, capture_output=True, text=True, check=True).stderr
        subprocess.run(["g++", "-shared", part, "-o", library, "-lm"], capture_output=True, check=True)
        return Library(ctypes.CDLL(library), "loop vectorized" in messages)


def cpp_steps(
    library: Library, v: VehicleConfig, columns: tuple[np.ndarray, ...]
) -> Callable[[], tuple[np.ndarray, ...]]:
    """Return a function that gives V, beta, r (n,) one step after V, beta, r, delta, Fxr, dt (n,), of one precision."""
    dtype, n = columns[0].dtype, len(columns[0])
    step = library.loaded[f"step_{dtype.name}"]
    end = tuple(np.empty(n, dtype) for _ in range(3))
    car = _Car(*(getattr(v, name) for name in PARAMETERS))
    inputs = tuple(map(np.ascontiguousarray, columns))
    arrays = [ctypes.c_void_p(array.ctypes.data) for array in (*inputs, *end)]

    def run() -> tuple[np.ndarray, ...]:
        step(ctypes.c_long(n), ctypes.byref(car), *arrays)
        assert len(inputs) == 6  # keeps the arrays alive as long as this function, which has their addresses
        return end

    return run
