"""`driftjax diagnose` from the shell: a hidden effect found, data that say nothing, one sentence for bad input."""

import csv
import functools
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from diagnosis.recorded import EFFECTS as KNOWN
from diagnosis.recorded import hidden, recorded

from driftjax.cli import main
from driftjax.diagnosis.diagnose import diagnose
from driftjax.logs import Run, write_log
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import EFFECTS


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Every test works in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def hidden_lag():
    """Runs of a sedan whose steering lags by a typical time."""
    return recorded(hidden(steer_lag=1.0), 5, 6)


def test_a_hidden_lag_is_named_extends_the_car_and_gains_on_runs_held_out(hidden_lag, capsys, monkeypatch):
    monkeypatch.setattr("driftjax.cli.diagnose.diagnose", functools.partial(diagnose, effects=KNOWN))
    write_log(Path("log.csv"), hidden_lag)
    options = ["log.csv", "--combined-slip", "1", "--out", "diagnosed", "--without", "friction_rear"]
    assert main(["diagnose", *options]) == 0
    content = json.loads(Path("diagnosed/diagnosis.json").read_text())
    assert (content["schema"], content["verdict"]) == (1, "NAMED")
    assert (content["named_by"], content["sizes_fitted_to"]) == ("single steps", "likelihood")
    assert [cause["effect"] for cause in content["causes"]] == ["steer_lag"]
    assert content["causes"][0]["exploratory"] is False and content["data"]["outliers"] == {"V": 0, "beta": 0, "r": 0}
    estimate = content["causes"][0]["parameters"]["tau"]
    true = next(p for p in EFFECTS["steer_lag"].parameters).typical * (3.05 / 9.81) ** 0.5
    assert estimate["unit"] == "s" and estimate["value"] == pytest.approx(true, rel=0.1)
    gain = content["gain"]
    names = [run.name for run in hidden_lag]
    assert gain["held_out_runs"] == names[2::3]
    # what process noise makes of a second in a drift counts as explainable, so that even the true car stays below 1
    assert gain["skill"]["extended"] > 0.5 and gain["ci95"]["extended"][0] > 0
    assert gain["skill"]["extended"] > gain["skill"]["retuned"]
    car = yaml.safe_load(Path("diagnosed/extended.yaml").read_text())
    assert car["effects"]["steer_lag"]["tau"]["value"] == pytest.approx(estimate["value"])
    vehicle = load_vehicle("diagnosed/extended.yaml")
    assert [(one.name, one.value) for one in vehicle.effects] == [("steer_lag.tau", estimate["value"])]
    assert vehicle.noise is not None
    assert vars(vehicle.noise.process_sigma) == content["data"]["process_sigma"]
    assert vehicle.noise.process_correlation_s == content["data"]["process_correlation_s"]
    half = vehicle.effects[0].ci95_half
    assert half is not None and 1.9 < half / vehicle.covariance[0][0] ** 0.5 < 2.3  # a quantile of Student's t
    shown = content["show"]
    assert set(shown["residual_forces"]) == {"p_value", "Fx", "Fyf", "Fyr"}
    assert "agree within noise" in shown["kinematic_parity"]["statement"]
    nominal = np.array([shown["open_loop"]["in_noises"][name] for name in ("V", "beta", "r")])
    assert nominal.shape == (3, 4) and (nominal[:, 0] < nominal[:, 2]).all()
    first = Path("diagnosed/report.html").read_text()
    assert first.count("data:image/png;base64,") == len(list(Path("diagnosed/figures").glob("*.pdf"))) == 8
    assert sum(path.stat().st_size for path in Path("diagnosed").glob("*.nc")) < 1e6
    Path("diagnosed/report.html").unlink()
    assert main(["report", "diagnosed"]) == 0
    assert Path("diagnosed/report.html").read_text().count("data:image/png;base64,") == 8
    out = capsys.readouterr().out
    assert shown["worst"] in out
    assert "NAMED: The steering lags behind its command" in out and "extended" in out
    assert main(["diagnose", *options]) == 2  # the folder holds a diagnosis already


@pytest.mark.slow
def test_a_diagnosis_of_the_extended_car_finds_nothing_more(hidden_lag, monkeypatch):
    """What was named is where the second one starts."""
    monkeypatch.setattr("driftjax.cli.diagnose.diagnose", functools.partial(diagnose, effects=KNOWN))
    write_log(Path("log.csv"), hidden_lag)
    options = ["diagnose", "log.csv", "--combined-slip", "1", "--held-out", "0", "--without", "friction_rear"]
    assert main([*options, "--out", "diagnosed"]) == 0
    more = ["--vehicle", "diagnosed/extended.yaml", "--without", "friction_rear", "--held-out", "0", "--out", "again"]
    assert main(["diagnose", "log.csv", *more]) == 0
    assert json.loads(Path("again/diagnosis.json").read_text())["verdict"] == "NOTHING"
    assert load_vehicle("again/extended.yaml").effects == load_vehicle("diagnosed/extended.yaml").effects


def test_two_seconds_of_data_say_nothing(capsys):
    t = np.arange(400) * 0.005
    wave = 0.1 * np.sin(5 * t)
    write_log(Path("short.csv"), [Run("a", t, 10 + wave, wave, wave, wave, 100 * wave, 0.005)])
    assert main(["diagnose", "short.csv", "--out", "short"]) == 0
    content = json.loads(Path("short/diagnosis.json").read_text())
    assert content["verdict"] == "DATA_INSUFFICIENT" and content["causes"] == []
    printed = capsys.readouterr().out
    assert "2.0 s" in content["sentence"] and "2.0 s" in printed
    assert (
        "note: All runs were thinned from 200 to 100 Hz" in printed
        and "from 200 to 100 Hz" in content["data"]["notes"][0]
    )
    assert "2.0 s" in Path("short/report.html").read_text()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: [row[:3] + row[4:] for row in rows], ("log.csv", "column 'r'")),
        (lambda rows: [rows[0], *[[*row[:2], str(57.3 * float(row[2])), *row[3:]] for row in rows[1:]]], ("degrees",)),
        (lambda rows: rows[:50] + rows[40:], ("log.csv", "t")),
        (lambda rows: [rows[0], [rows[1][0], "fast", *rows[1][2:]], *rows[2:]], ("log.csv", "fast")),
    ],
)
def test_a_bad_log_is_one_sentence_and_leaves_nothing(change, words, capsys):
    t = np.arange(600) * 0.01
    wave = 0.1 * np.sin(5 * t)
    write_log(Path("log.csv"), [Run("a", t, 10 + wave, wave, wave, wave, 100 * wave, 0.01)])
    with open("log.csv", newline="") as file:
        rows = list(csv.reader(file))
    with open("log.csv", "w", newline="") as file:
        csv.writer(file).writerows(change(rows))
    assert main(["diagnose", "log.csv", "--out", "out"]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and all(word in lines[0] for word in words)
    assert not Path("out").exists()


def test_an_unknown_effect_and_a_missing_log_are_bad_input(capsys):
    assert main(["diagnose", "none.csv"]) == 2
    assert "none.csv" in capsys.readouterr().err
    t = np.arange(600) * 0.01
    wave = 0.1 * np.sin(5 * t)
    write_log(Path("log.csv"), [Run("a", t, 10 + wave, wave, wave, wave, 100 * wave, 0.01)])
    assert main(["diagnose", "log.csv", "--without", "magic"]) == 2
    assert "magic" in capsys.readouterr().err
    assert main(["diagnose", "log.csv", "--most", "0"]) == 2
    assert "key 'most' is 0" in capsys.readouterr().err
    assert main(["diagnose", "log.csv", "--drive", "truth.yaml", "--columns", "dart_jetracer"]) == 2
    assert "leave --columns and --runs out" in capsys.readouterr().err
