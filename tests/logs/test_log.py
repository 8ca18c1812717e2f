"""Measured logs: exact round trips, cuts and repairs reported, and one sentence for whatever cannot be read."""

import hashlib
import re
from typing import Any

import numpy as np
import pytest
from made_up import N, columns, write

from driftjax.core import BadInput
from driftjax.logs import Run, read_log, write_log
from driftjax.logs.columns import CHANNELS


def run_of(name: str, seed: int = 0, **extra) -> Run:
    arrays: dict[str, Any] = {key: np.array(values) for key, values in columns(seed=seed).items()}
    return Run(name, **arrays, dt=0.01, extra=extra)


def assert_same(a: Run, b: Run) -> None:
    assert a.name == b.name and a.dt == pytest.approx(b.dt, rel=1e-8)
    for name in CHANNELS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for name, values in a.extra.items():
        np.testing.assert_array_equal(values, b.extra[name], err_msg=name)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_what_is_written_comes_back_to_the_last_digit(tmp_path, suffix):
    wfl = np.random.default_rng(1).normal(size=N)
    first, second = run_of("left, slow", psi=np.linspace(0, 50, N)), run_of("2", seed=1, wfl=wfl)
    first.V[7] = np.nan
    path = tmp_path / f"log{suffix}"
    write_log(path, [first, second])
    log = read_log([path])
    for a, b in zip([first, second], log.runs, strict=True):
        assert_same(a, b)
    assert np.isnan(log.runs[0].extra["wfl"]).all() and log.rows == 2 * N and log.paths == (path,)
    assert log.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert [note for note in log.notes if "1 of V" in note and "'left, slow'" in note] == list(log.notes)


def test_files_are_runs_in_the_order_given_and_the_hash_covers_all(tmp_path):
    (tmp_path / "again").mkdir()
    paths = [write(tmp_path / f"{name}.csv", columns(seed=i)) for i, name in enumerate(["b", "a", "again/a"])]
    log = read_log(paths)
    assert [run.name for run in log.runs] == ["b", "a", "a/a"] and log.notes == ()
    assert log.sha256 == hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def test_velocities_stand_for_speed_and_sideslip(tmp_path):
    values = columns()
    V, beta = (np.array(values.pop(name)) for name in ("V", "beta"))
    path = write(tmp_path / "log.csv", values | {"vx": (V * np.cos(beta)).tolist(), "vy": (V * np.sin(beta)).tolist()})
    run = read_log([path]).runs[0]
    np.testing.assert_allclose(run.V, V, rtol=1e-14)
    np.testing.assert_allclose(run.beta, beta, atol=1e-14)
    assert run.extra == {}


def test_a_log_without_sideslip_or_force_is_read_and_says_so(tmp_path):
    given = columns()
    log = read_log(
        write(tmp_path / "log.csv", {k: v for k, v in given.items() if k not in ("beta", "Fxr")} | {"vx": given["V"]})
    )
    (run,) = log.runs
    assert np.isnan(run.beta).all() and np.isnan(run.Fxr).all() and len(run.t) == N
    np.testing.assert_array_equal(run.r, given["r"])
    assert [note.partition(": ")[2] for note in log.notes] == [
        "columns that the log format does not have were left out: 'vx'.",
        "has no beta; sideslip is inferred from the other channels.",
        "has no Fxr; the force is estimated from the speed, and drive, brakes and drag are not judged.",
    ]
    write_log(tmp_path / "again.csv", log.runs)
    (again,) = read_log(tmp_path / "again.csv").runs
    assert np.isnan(again.beta).all() and "beta" not in (tmp_path / "again.csv").read_text()


def test_comments_blank_lines_other_delimiters_and_unknown_columns(tmp_path):
    values = columns() | {"lap": [1] * N}
    path = write(tmp_path / "log.csv", values)
    path.write_text("\ufeff# made up\n\n" + path.read_text().replace(",", " ; "), encoding="utf-8")
    log = read_log([path])
    np.testing.assert_array_equal(log.runs[0].r, values["r"])
    assert len(log.notes) == 1 and "'lap'" in log.notes[0]


def test_a_jump_of_the_time_cuts_the_run(tmp_path):
    values = columns()
    values["t"] = [t + (5.0 if i >= 100 else 0) + (0.12 if i >= 200 else 0) for i, t in enumerate(values["t"])]
    values["t"][299] += 1.0
    log = read_log([write(tmp_path / "lap.csv", values)])
    assert [(run.name, len(run.t)) for run in log.runs] == [("lap", 100), ("lap+1", 100), ("lap+2", 99)]
    np.testing.assert_array_equal(log.runs[1].V, values["V"][100:200])
    assert any("3 parts" in note for note in log.notes) and any("left out: 1." in note for note in log.notes)


def test_part_names_stay_clear_of_runs_that_have_them(tmp_path):
    values = columns()
    values["t"] = [t + (5.0 if i >= 100 else 0) for i, t in enumerate(values["t"])]
    values["run"] = ["a"] * 200 + ["a+1"] * 100
    assert [run.name for run in read_log([write(tmp_path / "f.csv", values)]).runs] == ["a", "a+1", "f/a+1"]


def test_lost_rows_count_as_missing_and_hold_the_commands(tmp_path):
    values = columns()
    path = write(tmp_path / "log.csv", {name: column[:50] + column[52:] for name, column in values.items()})
    log = read_log([path])
    (run,) = log.runs
    np.testing.assert_allclose(run.t, values["t"], atol=1e-12)
    assert np.isnan(run.V[50:52]).all() and np.isfinite(np.delete(run.V, [50, 51])).all()
    np.testing.assert_array_equal(run.delta, values["delta"][:50] + 2 * [values["delta"][49]] + values["delta"][52:])
    assert len(log.notes) == 1 and log.notes[0].endswith("held: 2.")


@pytest.mark.parametrize(("size", "resampled"), [(0.004, False), (0.09, True)])
def test_jitter_is_resampled_where_it_matters(tmp_path, size, resampled):
    t = 0.01 * np.arange(N)
    shaken = t + 0.01 * size * np.random.default_rng(0).uniform(-1, 1, N)
    values = columns() | {"t": shaken.tolist(), "V": (10 + 3 * shaken).tolist()}
    log = read_log([write(tmp_path / "log.csv", values)])
    (run,) = log.runs
    assert any("resampled" in note for note in log.notes) == resampled
    if not resampled:
        np.testing.assert_array_equal(run.t, shaken)
    assert run.dt == pytest.approx(0.01, rel=1e-3)
    np.testing.assert_allclose(run.V, 10 + 3 * run.t, atol=4e-4)  # samples within 1 % of the sample time are taken
    assert np.ptp(np.diff(run.t)) < (1e-12 if resampled else 2e-4)


def test_rounded_time_stamps_keep_the_true_rate(tmp_path):
    values = columns(dt=1 / 60)
    values["t"] = [round(t, 3) for t in values["t"]]
    (run,) = read_log([write(tmp_path / "log.csv", values)]).runs
    assert run.dt == pytest.approx(1 / 60, rel=1e-3) and len(run.t) == N


def test_missing_measurements_stay_missing_and_rows_without_a_time_go(tmp_path):
    values = columns()
    values["V"][10], values["beta"][11], values["r"][12], values["t"][60] = "", "NaN", " n/a ", ""
    log = read_log([write(tmp_path / "log.csv", values)])
    (run,) = log.runs
    assert [np.flatnonzero(np.isnan(y)).tolist() for y in (run.V, run.beta, run.r)] == [[10, 60], [11, 60], [12, 60]]
    assert any("left out: 1." in note for note in log.notes)
    assert any("1 of V, 1 of beta, 1 of r" in note for note in log.notes)


def test_short_gaps_of_the_commands_are_held_and_long_ones_cut_the_run(tmp_path):
    values = columns()
    values["delta"][0] = ""
    values["delta"][50:53] = values["Fxr"][52:55] = ["", "", ""]
    values["r"][100:110] = values["delta"][100:110] = [""] * 10
    values["Fxr"][150:161] = [""] * 11
    log = read_log([write(tmp_path / "log.csv", values)])
    assert [(len(run.t), run.t[0]) for run in log.runs] == [(149, 0.01), (N - 161, 1.61)]
    first = log.runs[0]
    np.testing.assert_array_equal(first.delta[49:52], 3 * [values["delta"][49]])
    np.testing.assert_array_equal(first.Fxr[50:54], 4 * [values["Fxr"][51]])
    assert any("sample before: 16." in note for note in log.notes)
    assert any("left out: 12." in note for note in log.notes)


def test_gaps_of_a_slow_log_are_bridged_by_samples_and_of_a_fast_one_by_time(tmp_path):
    """Of a log at 100 Hz that loses 5 samples every second nothing is cut, and one at 10 Hz bridges 3 of its steps."""
    fast = {name: np.delete(y, np.arange(50, 55)).tolist() for name, y in columns().items()}
    (run,) = read_log([write(tmp_path / "fast.csv", fast)]).runs
    assert len(run.t) == N and np.isnan(run.V[50:55]).all() and (run.delta[50:55] == run.delta[49]).all()
    slow = columns() | {"t": (0.1 * np.arange(N)).tolist()}
    for lost, parts in ((2, 1), (3, 2)):
        kept = {name: np.delete(y, np.arange(50, 50 + lost)).tolist() for name, y in slow.items()}
        assert len(read_log([write(tmp_path / f"slow{lost}.csv", kept)]).runs) == parts


def test_sideslip_at_standstill_counts_as_missing(tmp_path):
    values = columns()
    values["V"][:5], values["beta"][:5] = [0.01] * 5, [3.0, -2.0, 0.5, 2.0, -3.1]
    log = read_log([write(tmp_path / "log.csv", values)])
    assert np.isnan(log.runs[0].beta[[0, 1, 3, 4]]).all() and log.runs[0].beta[2] == 0.5
    assert any("count as missing: 4." in note for note in log.notes)


def test_heading_is_unwrapped(tmp_path):
    psi = np.linspace(0, 30, N)
    path = write(tmp_path / "log.csv", columns() | {"psi": ((psi + np.pi) % (2 * np.pi) - np.pi).tolist()})
    np.testing.assert_allclose(read_log([path]).runs[0].extra["psi"], psi, atol=1e-12)


def test_coasting_and_short_logs_are_no_errors(tmp_path):
    coasting = columns(60) | {"delta": [0.0] * 60, "Fxr": [0] * 60}
    assert read_log([write(tmp_path / "coasting.csv", coasting)]).rows == 60
    assert read_log([write(tmp_path / "short.csv", columns(2))]).rows == 2


def put(name: str, row: int, value) -> dict[str, list]:
    """A drive with another value in one line of the file."""
    values = columns()
    values[name][row - 2] = value
    return values


BAD = {
    "a column is missing": ({k: v for k, v in columns().items() if k != "r"}, "column 'r' is missing"),
    "no speed": ({k: v for k, v in columns().items() if k != "V"}, r"column 'V' is missing; add it (or vx and vy"),
    "half a velocity": (
        {k: v for k, v in columns().items() if k != "V"} | {"vx": [1.0] * N},
        "column 'V' is missing",
    ),
    "a column is repeated": (columns() | {" r": [0.0] * N}, "column 'r' is there 2 times"),
    "text": (put("r", 42, "fast"), "row 42: column 'r' holds 'fast', not a number"),
    "decimal comma": (put("r", 42, '"0,5"'), "row 42: column 'r' holds '0,5', not a number with a decimal point"),
    "infinite": (put("Fxr", 42, "inf"), "row 42: column 'Fxr' is infinite"),
    "a row is too long": (put("V", 42, "1,2"), "row 42: has 7 cells for 6 columns"),
    "time stands still": (put("t", 42, 0.01 * 39), "row 42: column 't' is 0.39 s, no more than in the row before"),
    "time goes back": (put("t", 42, 0.0), "row 42: column 't' is 0 s, no more than in the row before"),
    "milliseconds": (
        columns() | {"t": list(range(0, 10 * N, 10))},
        "column 't' steps by 10, which looks like millisec",
    ),
    "jitter": (
        columns() | {"t": (0.01 * np.arange(N) + 0.003 * (np.arange(N) % 2)).tolist()},
        r"the steps of column 't' vary by \d+ %",
    ),
    "speed is stuck": (columns() | {"V": [3.0] * N}, "column 'V' is 3 in all 300 rows, which looks like a stuck"),
    "sideslip is stuck": (columns() | {"beta": ["", *[0] * (N - 1)]}, "column 'beta' is 0 in all 299 rows"),
    "yaw rate is stuck": (columns() | {"r": [0.1] * N}, "column 'r' is 0.1 in all 300 rows"),
    "nothing measured": (columns() | {"r": [""] * N}, "column 'r' has no value in any row"),
    "no command": (columns() | {"delta": [""] * N}, "column 'delta' has no value in any row"),
    "backwards": (put("V", 42, -0.5), "row 42: column 'V' is -0.5 m/s; speed is not negative"),
    "sideslip in degrees": (put("beta", 42, 4.5), "row 42: column 'beta' is 4.5 rad; this looks like degrees"),
    "steering in degrees": (put("delta", 42, -20), "row 42: column 'delta' is -20 rad; this looks like degrees"),
    "yaw rate in degrees": (put("r", 42, 57.3), "row 42: column 'r' is 57.3 rad/s; this looks like degrees per second"),
    "a run without a name": (columns() | {"run": ["a"] * 40 + [""] * (N - 40)}, "row 42: column 'run' is empty"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_values_are_reported_in_one_sentence(tmp_path, case):
    values, sentence = BAD[case]
    path = write(tmp_path / "log.csv", values)
    with pytest.raises(BadInput, match=sentence.replace("(", r"\(")) as error:
        read_log([path])
    assert str(error.value).startswith(str(path)) and str(error.value).endswith(".") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "no such file"),
        (b"", "is empty"),
        (b" \n\n", "is empty"),
        (b"# only a comment\n", "is empty"),
        (b"t,V,beta,r,delta,Fxr\n", "holds names of columns but no rows"),
        (b"t,V,beta,r,delta,Fxr\n0,1,0,0,0,0\n", "no run has two samples in a row"),
        (b"\xff\xfe\x00", "neither text in UTF-8, UTF-16 or Latin-1 nor Parquet"),
    ],
)
def test_files_that_are_no_log_are_reported(tmp_path, content, sentence):
    path = tmp_path / "log.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(BadInput, match=f"^{re.escape(str(path))}: .*{sentence}.*[.]$"):
        read_log([path])


def test_a_folder_no_log_and_the_same_log_twice_are_reported(tmp_path):
    with pytest.raises(BadInput, match="is a folder without the metadata.yaml of a ROS 2 bag"):
        read_log([tmp_path])
    with pytest.raises(BadInput, match="No log was given"):
        read_log([])
    paths = [write(tmp_path / name, columns()) for name in ("a.csv", "b.csv")]
    with pytest.raises(BadInput, match=r"b\.csv: holds the same as .*a\.csv"):
        read_log(paths)


def test_rates_that_differ_are_reported_with_both_runs(tmp_path):
    paths = [write(tmp_path / f"{name}.csv", columns(dt=dt)) for name, dt in (("slow", 0.05), ("fast", 0.01))]
    with pytest.raises(BadInput, match=r"'slow' has 20 Hz but run 'fast' has 100 Hz; .*rate"):
        read_log(paths)
    close = [write(tmp_path / f"{dt}.csv", columns(dt=dt)) for dt in (0.01, 0.01005)]
    assert len(read_log(close).runs) == 2


def test_parquet_that_is_broken_or_holds_text(tmp_path):
    import pyarrow
    from pyarrow import parquet

    path = tmp_path / "log.parquet"
    path.write_bytes(b"PAR1 and no more")
    with pytest.raises(BadInput, match=r"log\.parquet: is no readable Parquet"):
        read_log([path])
    values = columns()
    parquet.write_table(pyarrow.table(values | {"r": ["fast", *map(str, values["r"][1:])], "run": [1] * N}), path)
    with pytest.raises(BadInput, match=r"log\.parquet, row 1: column 'r' holds 'fast'"):
        read_log([path])
    parquet.write_table(pyarrow.table(values | {"run": [1] * N}), path)
    assert read_log([path]).runs[0].name == "1"
    content = path.read_bytes()
    start = content.rindex(b"org.apache") if b"org.apache" in content else len(content) - 200
    for at in range(start, len(content) - 8, 5):
        path.write_bytes(content[:at] + b"\x1b\n" + content[at + 2 :])
        try:
            read_log([path])
        except BadInput as error:
            assert str(error).isprintable() and str(error).endswith(".")
        path.write_bytes(content[:100] + content[at:])
        with pytest.raises(BadInput) as refused:
            read_log([path])
        assert str(refused.value).isprintable() and str(refused.value).endswith(".")


def test_logs_that_cannot_be_written_are_reported(tmp_path):
    for path, runs, sentence in (
        (tmp_path / "log.mat", [run_of("a")], "csv or .parquet"),
        (tmp_path / "none" / "log.csv", [run_of("a")], "cannot be written"),
        (tmp_path / "log.csv", [], "no run to write"),
    ):
        with pytest.raises(BadInput, match=sentence):
            write_log(path, runs)
    assert list(tmp_path.iterdir()) == []


def test_a_header_behind_a_hash_and_a_line_of_units_are_read_as_they_are(tmp_path):
    header, *rows = write(tmp_path / "plain.csv", columns()).read_text().splitlines()
    units = ",".join(["m/s"] * len(header.split(",")))
    (tmp_path / "hash.csv").write_text("\n".join(["# made by hand", f"# {header}", *rows]))
    (tmp_path / "units.csv").write_text("\n".join([header, units, *rows]))
    plain, behind_hash, with_units = (read_log([tmp_path / f"{name}.csv"]) for name in ("plain", "hash", "units"))
    assert not plain.notes and not behind_hash.notes and "the units that it states (t m/s" in with_units.notes[0]
    for name in CHANNELS:
        expected = getattr(plain.runs[0], name)
        np.testing.assert_array_equal(getattr(behind_hash.runs[0], name), expected)
        np.testing.assert_array_equal(getattr(with_units.runs[0], name), expected)


def test_a_missing_column_is_reported_with_those_that_there_are(tmp_path):
    path = write(tmp_path / "log.csv", {{"r": "yaw_rate"}.get(k, k): v for k, v in columns().items()})
    with pytest.raises(BadInput, match="column 'r' is missing; .* There are '.*'yaw_rate'"):
        read_log([path])


def test_runs_are_chosen_by_name_and_cut_into_parts(tmp_path):
    path = write(tmp_path / "log.csv", columns(n=1000) | {"run": ["grip/a"] * 700 + ["ice/b"] * 300})
    log = read_log([path])
    assert [run.name for run in log.select_runs(["ice*", "none"]).runs] == ["ice/b"] and log.select_runs(()) is log
    with pytest.raises(BadInput, match=r"no run is called lap\*; the log holds grip/a, ice/b"):
        log.select_runs(["lap*"])
    cut = log.split_runs(3.0)
    assert [(run.name, len(run.t)) for run in cut.runs] == [("grip/a@0", 300), ("grip/a@3", 400), ("ice/b", 300)]
    assert [run.name for run in cut.select_runs(["grip/*"]).runs] == ["grip/a@0", "grip/a@3"]
    assert [run.name for run in cut.select_runs(["grip/a"]).runs] == ["grip/a@0", "grip/a@3"]
    assert [run.name for run in cut.select_runs(["*@3"]).runs] == ["grip/a@3"]
    uncut, parts = log.runs[0], cut.runs[:2]
    for name in CHANNELS:
        np.testing.assert_array_equal(np.concatenate([getattr(run, name) for run in parts]), getattr(uncut, name))
    assert log.split_runs(None) is log and cut.rows == log.rows


def test_thinning_keeps_whole_runs_and_averages_what_is_held(tmp_path):
    values = columns() | {"delta": (0.001 * np.arange(N)).tolist()}
    log = read_log([write(tmp_path / "log.csv", values)])
    for rate, factor in ((60.0, 1), (50.0, 2), (34.0, 2), (12.0, 8)):
        (run,) = log.thin(rate).runs
        assert run.dt == pytest.approx(0.01 * factor) and len(run.t) == -(-N // factor)
        np.testing.assert_array_equal(run.r, log.runs[0].r[::factor])
        np.testing.assert_allclose(run.delta[:-1], log.runs[0].delta[::factor][:-1] + 0.0005 * (factor - 1), atol=1e-12)
        assert run.extra.keys() == log.runs[0].extra.keys()
    assert log.thin(60.0) is log and "thinned from 100 to 50 Hz" in log.thin(50.0).notes[-1]
