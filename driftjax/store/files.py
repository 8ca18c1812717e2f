"""Read and write netCDF and JSON files; writing is atomic."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from driftjax.core import BadInput, write_atomically, write_text


def write_netcdf(path: Path, data: xr.Dataset) -> None:
    """Write `data`, compressed, as netCDF-4."""
    packed = {
        name: {"zlib": True, "complevel": 4}
        for name, variable in data.variables.items()
        if variable.ndim > 0 and variable.dtype.kind in "fib"
    }
    write_atomically(path, lambda p: data.to_netcdf(p, engine="netcdf4", encoding=packed))


def read_netcdf(path: Path) -> xr.Dataset:
    """Read the whole dataset into memory; raises `BadInput` that names the file."""
    try:
        with xr.open_dataset(path, engine="netcdf4", decode_timedelta=False) as data:
            return data.load()
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file; the run has not got that far.") from None
    except OSError as error:
        raise BadInput(f"{path}: not a readable netCDF file ({error}); delete it and resume the run.") from None


def write_json(path: Path, values: Any) -> None:
    """Write strict JSON: numbers that are not finite become null."""
    text = json.dumps(to_json_types(values), indent=2, allow_nan=False)
    write_text(path, text + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file; raises `BadInput` that names the file."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file; the run has not got that far.") from None
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: not readable JSON ({error}); delete it and resume the run.") from None


def to_json_types(value: Any) -> Any:
    """Return `value` in JSON types: arrays as lists, paths as strings, non-finite numbers as None."""
    if isinstance(value, dict):
        return {str(key): to_json_types(item) for key, item in value.items()}
    if isinstance(value, str | bool | None):
        return str(value) if isinstance(value, str) else value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [to_json_types(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return to_json_types(np.asarray(value).tolist())
