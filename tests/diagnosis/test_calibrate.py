"""`driftjax calibrate`: a car fitted to runs, its gain on others, and one sentence for what cannot be fitted."""

import functools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS as KNOWN
from diagnosis.recorded import hidden, recorded

from driftjax.cli import main
from driftjax.core import BadInput
from driftjax.diagnosis.calibrate import calibrate, effects_to_fit, select_effects
from driftjax.diagnosis.fit import initial_problem
from driftjax.logs import Log, write_log
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import effects_by_name


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Every test works in an empty folder."""
    monkeypatch.chdir(tmp_path)


TRUE = {"friction_rear": -1.0, "stiffness_front": 0.8, "steer_offset": -0.7}


@pytest.mark.parametrize("by", [(), pytest.param(("--staged",), marks=pytest.mark.slow)])
def test_sizes_are_those_hidden_and_gain_on_runs_held_out(by, monkeypatch, capsys):
    monkeypatch.setattr("driftjax.cli.calibrate.calibrate", functools.partial(calibrate, catalogue=KNOWN))
    write_log(Path("log.csv"), recorded(hidden(**TRUE), 5, 6))
    assert main(["calibrate", "log.csv", "--combined-slip", "1", "--effects", *TRUE, "--out", "car", *by]) == 0
    car = load_vehicle("car/calibrated.yaml")
    typical = {effect.name: effect.parameters[0].scale(car) for effect in KNOWN}
    assert [one.effect for one in car.effects] == [effect.name for effect in KNOWN if effect.name in TRUE]
    for one in car.effects:
        assert one.ci95_half is not None
        assert abs(one.value - TRUE[one.effect] * typical[one.effect]) < 1.5 * one.ci95_half < 0.3 * typical[one.effect]
    content = json.loads(Path("car/calibration.json").read_text())
    assert not any(row["at_bound"] or row["dead"] or row["flat"] for row in content["parameters"])
    assert all(np.isclose(sum(row["decided_by"].values()), 1, atol=0.01) for row in content["parameters"])
    decided = {row["parameter"]: max(row["decided_by"], key=row["decided_by"].get) for row in content["parameters"]}
    assert decided["friction_rear.p"] == "limit" and content["staged"] == bool(by)
    assert content["gain"]["ci95"]["fitted"][0] > 0.5 and len(content["gain"]["held_out_runs"]) == 2
    words = capsys.readouterr().out
    assert "friction_rear.p" in words and "nominal" in words and "fitted" in words
    stages = [f"74/100 fit: pass 1, {stage}" for stage in ("cornering", "limit") if by]  # straight: nothing to fit
    steps = [
        "0/100 noise and nominal car: compile",
        "21/100 gain: fit without",
        "74/100 fit: to all runs",
        *stages,
        "99/100 what decides",
        "100/100 done",
    ]
    assert sorted(steps, key=words.index) == steps
    assert "next: `driftjax diagnose log.csv --vehicle car/calibrated.yaml --runs ...`" in words
    assert np.shape(car.covariance) == (3, 3)


def test_help_names_the_default_effects(capsys):
    assert main(["calibrate", "--help"]) == 0
    output = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "left out: friction, stiffness_front, stiffness_rear, drive_gain, steer_offset, and with" in output
    assert "drive_lag, rolling_resistance, aero_drag, steer_gain, steer_lag, tyre_shape, combined_slip." in output


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--effects", "frictoin"], "effect 'frictoin': no such effect"),
        (["--effects", "friction_patch"], "effect 'friction_patch' needs the column s, which a run lacks"),
        (["--held-out", "1"], "key 'held_out' is 1"),
        (["--runs", "lap*"], "no run is called lap*; the log holds drift"),
    ],
)
def test_bad_input_is_reported_in_one_sentence(flags, words, capsys):
    runs = recorded(hidden(), 5, 6)[:2]
    bare = [type(run)(run.name, run.t, run.V, run.beta, run.r, run.delta, run.Fxr, run.dt) for run in runs]
    write_log(Path("log.csv"), bare)
    assert main(["calibrate", "log.csv", *flags, "--out", "car"]) == 2
    output = capsys.readouterr()
    assert words in output.err and output.err.count("\n") == 1 and not Path("car").exists()


def test_default_effects_that_a_log_cannot_determine_are_left_out():
    runs = tuple(replace(run, Fxr=np.full(len(run.t), np.nan)) for run in recorded(hidden(**TRUE), 5, 6)[:2])
    car, wanted = load_vehicle("sedan"), effects_to_fit(staged=True)
    problem = initial_problem(car, effects_by_name(wanted), runs)
    selected, missing = select_effects(problem, wanted)
    assert missing == dict.fromkeys(sorted(missing), "Fxr") and {"drive_gain", "combined_slip"} <= set(missing)
    assert {problem.effects[i].name for i in selected} == set(wanted) - set(missing) >= {"friction", "steer_gain"}
    with pytest.raises(BadInput, match="effect 'combined_slip' needs the column Fxr, which a run lacks"):
        calibrate(car, Log(runs), ("combined_slip",))
