"""The study of missing channels: what is taken out, and how cases are counted."""

import json

import numpy as np
import pytest

import driftjax as dj
from experiments.missing_channels import MASKS, Config, draw_study, main, masked, outcomes, table


def row(channels, hidden, named, verdict="NAMED", sets=None, exploratory=()):
    return {
        "channels": channels,
        "hidden": hidden,
        "named": named,
        "verdict": verdict,
        "sets": sets or [[n] for n in named],
        "exploratory": [*exploratory],
    }


def test_channels_are_taken_out_and_with_the_sideslip_the_pose():
    wave = np.sin(np.arange(20.0))
    run = dj.Run(
        "a", 0.01 * np.arange(20), 10 + wave, wave, wave, wave, wave, 0.01, {"psi": wave, "x": wave, "ay": wave}
    )
    both = masked(run, MASKS["neither"])
    assert np.isnan(both.beta).all() and np.isnan(both.Fxr).all() and set(both.extra) == {"ay"}
    assert set(masked(run, MASKS["no force"]).extra) == {"psi", "x", "ay"} and np.isfinite(run.beta).all()


def test_a_yaw_rate_is_taken_out_but_not_the_heading():
    wave = np.sin(np.arange(20.0))
    run = dj.Run("a", 0.01 * np.arange(20), 10 + wave, wave, wave, wave, wave, 0.01, {"psi": wave, "ay": wave})
    assert np.isnan(masked(run, MASKS["no yaw rate"]).r).all() and "psi" in masked(run, MASKS["no yaw rate"]).extra


def test_cases_are_the_same_for_a_seed_and_every_fifth_hides_nothing():
    cases = draw_study(Config(cases=5, cars=("rc",)))
    assert [len(case.names) for case in cases].count(0) == 1 and cases == draw_study(Config(cases=5, cars=("rc",)))


def test_results_of_an_older_version_are_refused(tmp_path):
    old = {key: value for key, value in row("neither", [], []).items() if key != "exploratory"}
    (tmp_path / "missing_channels.jsonl").write_text(json.dumps(old | {"case": {}}))
    with pytest.raises(dj.BadInput, match="missing_channels.jsonl: an older version wrote it; choose another folder"):
        main(Config(out=tmp_path))


def test_outcomes_are_counted_per_set_of_channels():
    assert outcomes(row("neither", [], ["mass"])) == ["nothing hidden", "named"]
    assert outcomes(row("neither", ["mass"], ["mass"])) == ["one hidden", "first", "in a set"]
    assert outcomes(row("neither", ["mass"], ["steer_lag", "mass"])) == ["one hidden", "beside", "in a set"]
    exploratory = row("neither", ["mass"], ["mass", "steer_lag"], exploratory=["steer_lag"])
    assert outcomes(exploratory) == ["one hidden", "first", "in a set"]
    rival = row("neither", ["mass"], ["drive_gain"], "SET", [["drive_gain", "mass"]])
    assert outcomes(rival) == ["one hidden", "in a set"]
    assert outcomes(row("neither", ["mass"], ["drive_gain"])) == ["one hidden", "false"]
    assert outcomes(row("neither", ["mass"], [], "UNKNOWN")) == ["one hidden"]
    assert "| neither | 2 | 1/1 | 0/1 | 1/1 | 0/1 | 1/1 |" in table(
        [row("neither", ["mass"], ["mass"]), row("neither", [], ["mass"])]
    )
