"""A run folder: config, versions and every finished stage, so that an interrupted run can be resumed.

config.yaml, versions.json, plan.nc, results.json, laps.nc, and in stages/ for each stage NN_name.state (what the
next stage starts from) and NN_name.nc (its laps). A stage is finished when its .nc exists.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import yaml

from driftjax.core import BadInput, read_yaml, write_atomically, write_text
from driftjax.store import files
from driftjax.store.variables import SHARED
from driftjax.store.versions import versions

CONFIG = "config.yaml"
RESUMABLE = ("learn", "paper")  # verbs with the flag --resume
FILL_VALUES = {"f": np.nan, "b": False, "i": -1}  # fill values of missing laps or steps, by dtype kind


class RunFolder:
    """One run on disk; every file is written atomically."""

    def __init__(self, path: Path, config: dict[str, Any], made: tuple[Path, ...] | None = None) -> None:
        self.path, self.config, self._made = path, config, made
        self._read: dict[Path, xr.Dataset] = {}  # stages that were read; a finished one never changes

    @classmethod
    def create(cls, path: str | Path, config: dict[str, Any], verb: str = "learn") -> "RunFolder":
        """Create the folder of a run of `driftjax <verb>` with `config`.

        Raises `BadInput` if it cannot be written or holds a run already.
        """
        path = Path(path)
        try:
            if (path / CONFIG).exists():
                again = f"continue it (--resume {path}) or " if _can_resume(path, verb) else ""
                raise BadInput(f"{path}: already holds a run; {again}give another folder (--out).")
            if path.exists() and not path.is_dir():
                raise BadInput(f"{path}: is a file, not a folder; give another folder (--out).")
            made = tuple(p for p in (path, *path.parents) if not p.exists())
        except OSError as error:
            raise BadInput(f"{path}: cannot be reached ({error.strerror}); give another folder (--out).") from None
        folder = cls(path, config, made)
        try:
            path.mkdir(parents=True, exist_ok=True)
            files.write_json(path / "versions.json", {"verb": verb} | versions())
            text = yaml.safe_dump(config, sort_keys=False, allow_unicode=True)
            write_text(path / CONFIG, text)
        except OSError as error:
            folder.discard()
            raise BadInput(f"{path}: cannot be written ({error.strerror}); give another folder (--out).") from None
        return folder

    @classmethod
    def ensure(cls, path: str | Path, config: dict[str, Any], verb: str) -> "RunFolder":
        """Open the run at `path`, or create it with `config` if there is none; raises `BadInput` for another verb's."""
        folder = cls.open(path) if (Path(path) / CONFIG).is_file() else cls.create(path, config, verb)
        if folder.verb != verb:
            raise BadInput(
                f"{path}: a run of `driftjax {folder.verb}`, not of `driftjax {verb}`; give another folder (--out)."
            )
        return folder

    @classmethod
    def resume(cls, path: str | Path, config: dict[str, Any], verb: str) -> "RunFolder":
        """Open the run at `path`, or create it; raises `BadInput` if it has another config."""
        folder = cls.ensure(path, config, verb)
        if folder.config != config:
            raise BadInput(f"{path}: holds a run with other options; give another folder (--out).")
        return folder

    @classmethod
    def open(cls, path: "str | Path | RunFolder") -> "RunFolder":
        """Open the run at `path`; raises `BadInput` if there is none. An open one is returned as it is."""
        if isinstance(path, RunFolder):
            return path
        path = Path(path)
        if not (path / CONFIG).is_file():
            raise BadInput(f"{path}: holds no run (there is no {CONFIG}); `driftjax runs` lists those there are.")
        return cls(path, read_yaml(path / CONFIG))

    def discard(self) -> None:
        """Undo `create`: remove the run's files and every folder that it made. Opened runs are unchanged."""
        if self._made is None:
            return
        if not self._made:
            for name in (CONFIG, "versions.json", "plan.nc"):
                (self.path / name).unlink(missing_ok=True)
            shutil.rmtree(self.path / "stages", ignore_errors=True)
        for path in self._made:
            if path == self.path:
                shutil.rmtree(path, ignore_errors=True)
            elif path.is_dir() and not any(path.iterdir()):
                path.rmdir()

    @property
    def created(self) -> str:
        """Return the start time of the run, ISO 8601, UTC."""
        return str(self.read_json("versions").get("created", ""))

    @property
    def verb(self) -> str:
        """Return the verb that made the run."""
        return str(self.read_json("versions").get("verb", "learn"))

    def finished(self) -> list[str]:
        """Return the names of the finished stages, in order."""
        return [path.stem[3:] for path in sorted((self.path / "stages").glob("[0-9][0-9]_*.nc"))]

    def has_results(self) -> bool:
        """Return whether a stage, or a trial of a sweep, has finished."""
        return bool(self.finished()) or any((self.path / "trials").glob("*.parquet"))

    def _stage(self, name: str) -> Path:
        names = self.finished()
        number = names.index(name) if name in names else len(names)
        return self.path / "stages" / f"{number:02d}_{name}"

    def write_stage(self, name: str, data: xr.Dataset, state: bytes) -> None:
        """Write stage `name`: first its state, last its laps, each atomically."""
        stem = self._stage(name)
        stem.parent.mkdir(exist_ok=True)
        write_atomically(stem.with_suffix(".state"), lambda p: p.write_bytes(state))
        files.write_netcdf(stem.with_suffix(".nc"), data.assign_attrs(stage=name))

    def read_stage(self, name: str) -> xr.Dataset:
        """Return the laps of a finished stage."""
        path = self._stage(name).with_suffix(".nc")
        if path not in self._read:
            self._read[path] = files.read_netcdf(path)
        return self._read[path]

    def read_state(self, name: str) -> bytes:
        """Return the initial state of the stage after `name`, serialised."""
        path = self._stage(name).with_suffix(".state")
        if not path.is_file():
            raise BadInput(f"{path}: no such file; the run has not got that far.")
        return path.read_bytes()

    def write_json(self, name: str, values: dict[str, Any]) -> None:
        """Write `name`.json; numbers that are not finite become null."""
        files.write_json(self._json(name), values)

    def read_json(self, name: str) -> dict[str, Any]:
        """Read `name`.json."""
        return files.read_json(self._json(name))

    def _json(self, name: str) -> Path:
        return self.path / f"{name.removesuffix('.json')}.json"

    def write_dataset(self, name: str, data: xr.Dataset) -> None:
        """Write a dataset of its own, such as plan.nc."""
        files.write_netcdf(self.path / name, data)

    def read_dataset(self, name: str) -> xr.Dataset:
        """Read the dataset in the file `name`."""
        return files.read_netcdf(self.path / name)

    def has(self, name: str) -> bool:
        """Return whether the run holds the file `name`."""
        return (self.path / name).is_file()

    @property
    def results(self) -> dict[str, Any]:
        """Return the results of the run: results.json."""
        return self.read_json("results")

    @property
    def laps(self) -> xr.Dataset:
        """Return the laps of all stages of a finished run: laps.nc, dimensions stage, lane, step."""
        return self.read_dataset("laps.nc")

    def write_laps(self) -> xr.Dataset:
        """Write and return laps.nc: the laps of all finished stages along a new dimension `stage`."""
        names = self.finished()
        if not names:
            raise BadInput(f"{self.path}: no stage has finished, so there are no laps to collect.")
        laps = stack_stages(dict(zip(names, map(self.read_stage, names), strict=True)))
        self.write_dataset("laps.nc", laps)
        return laps


def _can_resume(path: Path, verb: str) -> bool:
    """Return whether `driftjax <verb> --resume` goes on with the run at `path`."""
    return verb in RESUMABLE and (path / "versions.json").is_file() and RunFolder(path, {}).verb == verb


def stack_stages(stages: dict[str, xr.Dataset]) -> xr.Dataset:
    """Stack stages along a new dimension `stage`; values that a stage lacks are NaN, False, -1 or empty."""
    sizes: dict[Any, int] = {}
    for data in stages.values():
        sizes |= {dim: max(size, sizes.get(dim, 0)) for dim, size in data.sizes.items()}
    variables: dict[Any, xr.Variable] = {}
    for name in dict.fromkeys(name for data in stages.values() for name in data.variables):
        parts = {i: data.variables[name] for i, data in enumerate(stages.values()) if name in data.variables}
        first = next(iter(parts.values()))
        if name in SHARED:
            variables[name] = max(parts.values(), key=lambda part: part.size)
            continue
        shape = tuple(sizes[dim] for dim in first.dims)
        dtype = first.dtype if first.dtype.kind in "fbi" else np.dtype(object)
        whole = np.full((len(stages), *shape), FILL_VALUES.get(dtype.kind, ""), dtype)
        for i, part in parts.items():
            whole[(i, *(slice(0, n) for n in part.shape))] = part.values
        variables[name] = xr.Variable(("stage", *first.dims), whole, first.attrs)
    words = {"units": "1", "long_name": "name of the stage"}
    coords = {"stage": xr.Variable("stage", np.array(list(stages), object), words)}
    for data in stages.values():
        coords |= {name: variables[name] for name in data.coords}
    return xr.Dataset({k: v for k, v in variables.items() if k not in coords}, coords)


def list_runs(root: str | Path) -> list[RunFolder]:
    """Return every run below `root`, oldest first."""
    paths = [path.parent for path in Path(root).rglob(CONFIG) if (path.parent / "versions.json").is_file()]
    return sorted(map(RunFolder.open, paths), key=lambda run: (run.created, str(run.path)))
