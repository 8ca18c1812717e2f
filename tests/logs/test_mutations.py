"""Damaged MATLAB, Parquet and CSV files are read or refused in one sentence, and guessed at, without a warning."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from damage import mutated

from driftjax.core import BadInput
from driftjax.logs import guess_columns, read_log

CASES = 100
T = np.arange(400) * 0.02
DRIVE = {"t": T, "V": 10 + np.sin(T), "beta": 0.1 * np.cos(T), "r": 0.3 * np.sin(0.7 * T),
         "delta": 0.08 * np.sin(0.7 * T), "Fxr": 900 * np.cos(T)}  # fmt: skip


def csv(columns: dict[str, np.ndarray]) -> bytes:
    rows = (",".join(f"{value:.6g}" for value in row) for row in zip(*columns.values(), strict=True))
    return "\n".join([",".join(columns), *rows]).encode()


def write_mat(folder: Path) -> Path:
    scipy.io.savemat(folder / "log.mat", {"car": DRIVE})
    return folder / "log.mat"


def write_parquet(folder: Path) -> Path:
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(
        pyarrow.table({name: values.tolist() for name, values in DRIVE.items()}), folder / "log.parquet"
    )
    return folder / "log.parquet"


def write_csv_file(folder: Path) -> Path:
    (folder / "log.csv").write_bytes(csv(DRIVE))
    return folder / "log.csv"


def write_csv_files(folder: Path) -> Path:
    (path := folder / "log").mkdir()
    (path / "imu.csv").write_bytes(csv({"time": T, "r": DRIVE["r"]}))
    (path / "car.csv").write_bytes(csv({name: DRIVE[name] for name in ("t", "V", "beta", "delta", "Fxr")}))
    return path


READ: dict[str, tuple[Callable[[Path], Path], int, Callable[[Path], object]]] = {
    "csv": (write_csv_file, CASES, read_log),
    "guessed csv": (write_csv_file, CASES // 2, guess_columns),
    "folder of csv": (write_csv_files, CASES // 2, guess_columns),
    "parquet": (write_parquet, CASES, read_log),
    "mat": (write_mat, CASES // 5, guess_columns),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", READ)
def test_mutations_are_read_or_refused(tmp_path, kind):
    write, cases, read = READ[kind]
    path = write(tmp_path)
    victim = path / "car.csv" if path.is_dir() else path
    content, rng, refused = victim.read_bytes(), np.random.default_rng(20261128), 0
    for _ in range(cases):
        victim.write_bytes(mutated(content, 400, rng))
        try:
            read(path)
        except BadInput as error:
            said = str(error)
            assert said.startswith(str(path)) and said.endswith(".") and said.isprintable(), said
            refused += 1
    assert 0 < refused < cases
