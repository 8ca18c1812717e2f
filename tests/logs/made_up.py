"""A made-up drive in the log format, and a way to write it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

N = 300


def columns(n: int = N, dt: float = 0.01, seed: int = 0) -> dict[str, list]:
    """A made-up drive in the log format."""
    t = dt * np.arange(n)
    noise = np.random.default_rng(seed).normal(size=(3, n))
    return {
        "t": t.tolist(),
        "V": (10 + np.sin(t) + 0.01 * noise[0]).tolist(),
        "beta": (0.2 * np.sin(2 * t) + 0.01 * noise[1]).tolist(),
        "r": (0.5 * np.cos(t) + 0.01 * noise[2]).tolist(),
        "delta": (0.1 * np.sin(3 * t)).tolist(),
        "Fxr": (500 * np.cos(2 * t)).tolist(),
    }


def write(path: Path, values: Mapping[str, Any], rows=slice(None)) -> Path:
    lines = [",".join(values), *(",".join(map(str, row)) for row in list(zip(*values.values(), strict=True))[rows])]
    path.write_text("\n".join(lines) + "\n")
    return path
