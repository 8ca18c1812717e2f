"""MATLAB files of both versions, as SciPy and h5py write them: nested structs, cells, matrices; damaged files."""

import os

import h5py
import numpy as np
import pytest
import scipy.io

from driftjax.core import BadInput
from driftjax.logs import read_log
from driftjax.logs.guess import guess_columns

N = 50
T = np.arange(N) * 0.02
CHANNELS = {"V": 10 + T, "beta": -0.1 * T, "r": 0.4 * T, "delta": 0.05 * T, "Fxr": 1000 * T}
MAP = """
columns:
  t: car.clock.t
  V: car.imu.V
  beta: {column: 'car.runs.1.beta', factor: 2.0}
  r: car.matrix.0
  delta: car.matrix.1
  Fxr: car.F
"""


def version_5(path, car):
    scipy.io.savemat(path, {"car": car, "note": "text", "one": 3.0})


def version_7_3(path, car):
    """As MATLAB does: columns of a matrix are rows in the file, cells are references to `#refs#`, text has a class."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["note"] = np.array([72, 105], "u2")
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
        for name in ("clock/t", "imu/V", "F", "matrix"):
            value = car
            for part in name.split("/"):
                value = value[part]
            file[f"car/{name}"] = np.atleast_2d(np.asarray(value).T)
        refs = [file.create_dataset(f"#refs#/{k}/beta", data=one["beta"][None]) for k, one in enumerate(car["runs"])]
        file["car/runs"] = np.array([ref.parent.ref for ref in refs], h5py.ref_dtype)[None]
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))


def nested() -> dict:
    runs = two({"beta": np.zeros(7)}, {"beta": CHANNELS["beta"] / 2})
    matrix = np.stack([CHANNELS["r"], CHANNELS["delta"]], axis=1)
    return {"clock": {"t": T}, "imu": {"V": CHANNELS["V"]}, "F": CHANNELS["Fxr"], "matrix": matrix, "runs": runs}


@pytest.mark.parametrize("write", [version_5, version_7_3])
def test_vectors_of_nested_structs_and_cells_are_columns(tmp_path, write):
    write(tmp_path / "log.mat", nested())
    (tmp_path / "map.yaml").write_text(MAP)
    run = read_log(tmp_path / "log.mat", str(tmp_path / "map.yaml")).runs[0]
    assert run.dt == pytest.approx(0.02)
    for name, values in CHANNELS.items():
        np.testing.assert_allclose(getattr(run, name), values, atol=1e-12)


@pytest.mark.parametrize("form", ["cells", "structs"])
def test_entries_of_cells_and_of_arrays_of_structs_are_runs(tmp_path, form):
    """Two runs of 20 and 30 samples; matrices with two columns and a cell that stands alone are none."""
    parts = {name: (values[:20], values[20:]) for name, values in CHANNELS.items()} | {"t": (T[:20], T[:30])}
    data = {"alone": two(np.ones(20), np.ones(20)), "left": np.ones((N, 2)), "right": np.ones((N, 2))}
    if form == "structs":
        runs = two(*({name: both[k] for name, both in parts.items()} for k in range(2)))
        named, data = {name: f"drives.{name}" for name in parts}, data | {"drives": runs}
    else:
        named, data = (
            {name: f"{name}_" for name in parts},
            data | {f"{name}_": two(*both) for name, both in parts.items()},
        )
    scipy.io.savemat(tmp_path / "log.mat", data)
    (tmp_path / "map.yaml").write_text(f"columns: {named}\nrun: run\n")
    log = read_log(tmp_path / "log.mat", str(tmp_path / "map.yaml"))
    assert [run.name for run in log.runs] == ["0", "1"]
    for k, run in enumerate(log.runs):
        for name in CHANNELS:
            np.testing.assert_allclose(getattr(run, name), parts[name][k], atol=1e-12, err_msg=name)
    guess = guess_columns(tmp_path / "log.mat")
    columns = {one.channel: one.column for one in guess.channels}
    assert (guess.run, columns["t"]) == ("run", named["t"])


def two(first, second) -> np.ndarray:
    """A cell with two entries."""
    cell = np.empty(2, object)
    cell[:] = [first, second]
    return cell


def test_a_file_in_the_log_format_needs_no_map(tmp_path):
    scipy.io.savemat(tmp_path / "log.mat", {"t": T, **CHANNELS, "other": np.zeros(N + 1)})
    np.testing.assert_array_equal(read_log(tmp_path / "log.mat").runs[0].V, CHANNELS["V"])


@pytest.mark.parametrize("write", [version_5, version_7_3])
def test_the_length_is_that_of_the_time(tmp_path, write):
    """The other run of the file is shorter, so its columns are not among those to choose from."""
    write(tmp_path / "log.mat", nested())
    (tmp_path / "map.yaml").write_text(MAP.replace("runs.1", "runs.0"))
    with pytest.raises(BadInput, match=r"column 'car\.runs\.0\.beta' is missing.*There are 'car\.runs\.1\.beta'"):
        read_log(tmp_path / "log.mat", str(tmp_path / "map.yaml"))


@pytest.mark.parametrize("write", [version_5, version_7_3])
def test_a_damaged_file_is_refused_in_one_sentence(tmp_path, write):
    path = tmp_path / "log.mat"
    write(path, nested())
    content = path.read_bytes()
    for size in (10, 200, len(content) // 2):
        path.write_bytes(content[:size])
        with pytest.raises(
            BadInput, match=r"log\.mat: (is no readable MATLAB file \(.*save it again|holds no numeric)"
        ):
            read_log(path)


def test_a_file_without_vectors_is_refused(tmp_path):
    scipy.io.savemat(tmp_path / "log.mat", {"note": "text"})
    with pytest.raises(BadInput, match=r"log\.mat: holds no numeric vector; save structs and arrays"):
        read_log(tmp_path / "log.mat")


def test_a_damaged_file_that_crashes_scipy_is_refused(tmp_path):
    path = tmp_path / "log.mat"
    scipy.io.savemat(path, {"t": T, **CHANNELS})
    content = bytearray(path.read_bytes())
    content[176] = 0xE2  # the kind of the first variable's values
    path.write_bytes(content)
    with pytest.raises(BadInput, match=r"log\.mat: is no readable MATLAB file \(its library crashed, exit -11\); save"):
        read_log(path)


def outside(file: h5py.Group, path, how: str) -> None:
    if how == "link":
        file["x"] = h5py.ExternalLink(str(path), "/t")
    elif how == "storage":
        file.create_dataset("x", (N,), float, external=[(str(path), 0, 8 * N)])
    else:
        layout = h5py.VirtualLayout((N,), float)
        layout[:] = h5py.VirtualSource(path, "t", (N,))
        file.create_virtual_dataset("x", layout)


@pytest.mark.parametrize("how", ["link", "storage", "virtual"])
@pytest.mark.parametrize("place", ["/", "car", "#refs#/0"])
def test_a_file_that_takes_data_from_others_is_refused_before_it_reads_them(tmp_path, how, place):
    """A pipe without a writer would be waited for."""
    os.mkfifo(pipe := tmp_path / "pipe")
    version_7_3(tmp_path / "log.mat", nested())
    with h5py.File(tmp_path / "log.mat", "a") as file:
        assert isinstance(group := file[place], h5py.Group)
        outside(group, pipe, how)
    with pytest.raises(BadInput, match=r"log\.mat: takes data from other files .*save the data in the file itself"):
        read_log(tmp_path / "log.mat")


def test_a_file_that_describes_absurdly_large_arrays_is_refused(tmp_path):
    version_7_3(tmp_path / "log.mat", nested())
    with h5py.File(tmp_path / "log.mat", "a") as file:
        file.create_dataset("zeros", (2**16, 2**13 + 1), float, chunks=(2**10, 2**10))  # that are not in the file
    with pytest.raises(BadInput, match=r"log\.mat: describes over 4 GiB of arrays; leave out"):
        read_log(tmp_path / "log.mat")
