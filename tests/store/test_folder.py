"""Run folders: whole or absent, resumable, and what they say to a person who names the wrong one."""

import json
import math

import numpy as np
import pytest
import xarray as xr

from driftjax.core import BadInput, write_atomically
from driftjax.store import RunFolder, code_names, dataset, list_runs
from driftjax.store.variables import PLAN, STAGE

CONFIG = {"car": "sedan", "plants": 2, "path": {"Q": [5.0, 100.0, 50.0]}, "track": "sedan_corner"}
CODES = {"RUNNING": 0, "COMPLETED": 1, "SPUN": 2}


def laps(lanes: int, steps: int, controller: str = "path", **more) -> xr.Dataset:
    grid = np.arange(lanes * steps, dtype=float).reshape(lanes, steps)
    values = {
        "t": 0.05 * np.arange(steps), "V": grid, "alive": grid >= 0, "num_steps": grid.astype(np.int32),
        "plant": [f"plant_{i}" for i in range(lanes)], "controller": [controller] * lanes,
        "seed": np.arange(lanes), "code": np.ones(lanes, int), "lateral_error": np.full(lanes, np.nan),
    }  # fmt: skip
    return dataset(values | more, {"codes": CODES, "car": "sedan"})


@pytest.fixture
def run(tmp_path) -> RunFolder:
    return RunFolder.create(tmp_path / "run", CONFIG)


def test_config_and_versions_come_back_exactly(run):
    again = RunFolder.open(run.path)
    assert again.config == CONFIG
    versions = again.read_json("versions")
    assert versions["numpy"] == np.__version__
    assert set(versions) >= {
        "driftjax",
        "jax",
        "jaxlib",
        "equinox",
        "optimistix",
        "python",
        "platform",
        "device",
        "commit",
    }


def test_stages_keep_their_order_values_and_words(run):
    written = laps(2, 5)
    run.write_stage("pursuit", laps(2, 5, "pursuit"), b"first")
    run.write_stage("nominal", written, b"\x00second")
    assert run.finished() == ["pursuit", "nominal"]
    assert run.read_state("nominal") == b"\x00second"
    back = run.read_stage("nominal")
    for name in map(str, written.variables):
        np.testing.assert_array_equal(back[name].values, written[name].values)
        assert back[name].attrs["units"] == STAGE[name].units
        assert back[name].attrs["long_name"] == STAGE[name].long_name
    assert back["alive"].dtype == bool
    assert code_names(back) == {number: name for name, number in CODES.items()}


def test_writing_a_stage_again_replaces_it(run):
    run.write_stage("nominal", laps(2, 5), b"old")
    run.write_stage("gpr-1", laps(2, 5), b"next")
    run.write_stage("nominal", laps(1, 5), b"new")
    assert run.finished() == ["nominal", "gpr-1"]
    assert run.read_state("nominal") == b"new" and run.read_stage("nominal").sizes["lane"] == 1


def test_a_stage_that_breaks_off_is_not_finished_and_leaves_no_litter(run, monkeypatch):
    def dies(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(xr.Dataset, "to_netcdf", dies)
    with pytest.raises(KeyboardInterrupt):
        run.write_stage("nominal", laps(2, 5), b"state")
    assert RunFolder.open(run.path).finished() == []
    assert [path.name for path in (run.path / "stages").iterdir()] == ["00_nominal.state"]


def test_the_old_file_survives_a_write_that_breaks_off(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")

    def half(temporary):
        temporary.write_text("ne")
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError):
        write_atomically(path, half)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_json_holds_null_for_what_is_not_finite(run):
    run.write_json("results", {"a": np.float64("nan"), "b": [1, np.int32(2), math.inf], "c": np.array([1.5, np.nan])})
    text = (run.path / "results.json").read_text()
    assert "NaN" not in text and "Infinity" not in text
    assert run.read_json("results") == {"a": None, "b": [1, 2, None], "c": [1.5, None]} == json.loads(text)


def test_collected_laps_pad_what_a_stage_lacks(run):
    run.write_stage("lqr", laps(1, 4, "lqr"), b"")
    Z = np.random.default_rng(0).normal(size=(2, 3, 5))
    run.write_stage("gpr-1", laps(2, 6, "path", gp_Z=Z, gp_mask=np.ones((2, 3), bool)), b"")
    run.write_laps()
    laps_of_all = run.read_dataset("laps.nc")
    assert laps_of_all.sizes["stage"] == 2 and list(laps_of_all["stage"].values) == ["lqr", "gpr-1"]
    np.testing.assert_array_equal(laps_of_all["V"].values[0, 0, :4], run.read_stage("lqr")["V"].values[0])
    assert np.isnan(laps_of_all["V"].values[0, 0, 4:]).all() and np.isnan(laps_of_all["V"].values[0, 1]).all()
    assert laps_of_all["controller"].values.tolist() == [["lqr", ""], ["path", "path"]]
    assert laps_of_all["code"].values.tolist() == [[1, -1], [1, 1]] and not laps_of_all["alive"].values[0, 1].any()
    assert np.isnan(laps_of_all["gp_Z"].values[0]).all() and not laps_of_all["gp_mask"].values[0].any()
    np.testing.assert_array_equal(laps_of_all["gp_Z"].values[1], Z)
    np.testing.assert_allclose(laps_of_all["t"].values, 0.05 * np.arange(6))
    assert laps_of_all["V"].attrs["units"] == "m/s"


def test_collect_without_stages_is_reported(run):
    with pytest.raises(BadInput, match="no stage has finished"):
        run.write_laps()


def test_a_folder_that_holds_a_run_is_not_overwritten(run):
    before = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
    with pytest.raises(BadInput, match="--resume"):
        RunFolder.create(run.path, {"car": "rc"})
    assert {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()} == before


def test_an_unwritable_path_is_reported_and_nothing_is_left(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(BadInput, match="cannot be written"):
        RunFolder.create(tmp_path / "file" / "run", CONFIG)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_path_that_is_a_file_is_reported_and_kept(tmp_path):
    (tmp_path / "file").write_text("mine")
    for make in (RunFolder.create, RunFolder.ensure):
        with pytest.raises(BadInput, match=r"file: is a file, not a folder; give another folder \(--out\)"):
            make(tmp_path / "file", CONFIG, "export")
    assert (tmp_path / "file").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("held", "asked", "resumed"),
    [("learn", "learn", True), ("paper", "paper", True), ("export", "export", False), ("paper", "learn", False)],
)
def test_a_taken_folder_advises_resume_only_where_the_verb_has_it(tmp_path, held, asked, resumed):
    RunFolder.create(tmp_path / "run", CONFIG, held)
    with pytest.raises(BadInput, match=r"already holds a run; .*give another folder \(--out\)") as refused:
        RunFolder.create(tmp_path / "run", CONFIG, asked)
    assert ("--resume" in str(refused.value)) is resumed


def test_opening_what_is_no_run_is_reported(tmp_path):
    with pytest.raises(BadInput, match="holds no run"):
        RunFolder.open(tmp_path)


def test_discard_removes_only_what_was_made(tmp_path):
    (tmp_path / "mine").mkdir()
    RunFolder.create(tmp_path / "mine" / "new" / "run", CONFIG).discard()
    assert list(tmp_path.rglob("*")) == [tmp_path / "mine"]
    (tmp_path / "mine" / "note").write_text("keep")
    RunFolder.create(tmp_path / "mine", CONFIG).discard()
    assert list((tmp_path / "mine").iterdir()) == [tmp_path / "mine" / "note"]


def test_reading_absent_names_are_reported(run):
    for read in (run.read_stage, run.read_state, run.read_json, run.read_dataset):
        with pytest.raises(BadInput, match="no such file"):
            read("absent")


def test_runs_are_listed_and_other_folders_passed_over(tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "config.yaml").write_text("a: 1")
    made = [RunFolder.create(tmp_path / "runs" / name, CONFIG).path for name in ("a", "b")]
    assert [run.path for run in list_runs(tmp_path)] == made
    assert list_runs(tmp_path / "absent") == []


def test_unknown_names_and_wrong_ranks_are_errors():
    with pytest.raises(KeyError, match="Vx is not in the table"):
        dataset({"Vx": np.zeros((1, 2))})
    with pytest.raises(ValueError, match="V has shape"):
        dataset({"V": np.zeros(2)})
    with pytest.raises(ValueError):
        dataset({"V": np.zeros((1, 2)), "r": np.zeros((1, 3))})


@pytest.mark.parametrize("table", [STAGE, PLAN])
def test_every_variable_says_its_unit_and_meaning(table):
    for name, variable in table.items():
        assert variable.units and variable.long_name and variable.dims, name
