"""Option files name what differs from a shipped car: read alike from Python and from the command line."""

import dataclasses
from pathlib import Path

import pytest

import driftjax as dj
from driftjax.core import BadInput
from driftjax.tune.config import complete_tune_config


@pytest.fixture
def partial(tmp_path):
    """Write options of the RC car to a file."""

    def write(text: str) -> Path:
        (tmp_path / "c.yaml").write_text(f"car: rc\n{text}")
        return tmp_path / "c.yaml"

    return write


def test_a_learn_file_changes_the_options_of_the_car_that_it_names(partial):
    rc = dj.load_learn_config("rc")
    config = dj.load_learn_config(partial("plants: 2\nmpc: {horizon: 12}\n"))
    assert config == dataclasses.replace(rc, plants=2, mpc=dataclasses.replace(rc.mpc, horizon=12))
    assert rc.mpc.dt == 0.02 and rc.lap.substeps == 40 and str(rc.track) == "rc_corner"
    assert dj.load_learn_config("sedan").vehicle == dj.LearnConfig().vehicle


def test_a_plan_file_changes_the_options_of_the_car_that_it_names(partial):
    rc = dj.load_plan_config("rc")
    assert dj.load_plan_config(partial("margin: 0.01\n")) == dataclasses.replace(rc, margin=0.01)
    assert (rc.V_max, rc.V_fair, rc.course_weight) == (8.0, None, 0.0)


def test_a_plan_file_without_a_car_is_that_of_the_car_that_learns(tmp_path):
    (tmp_path / "p.yaml").write_text("margin: 0.01\n")
    for car in ("sedan", "rc"):
        config = dj.load_plan_config(tmp_path / "p.yaml", car)
        assert config == dataclasses.replace(dj.load_plan_config(car), margin=0.01)


def test_tuning_completes_the_options_of_learn():
    config = complete_tune_config({"training": 2, "learn": {"car": "rc", "seed": 5}}, "c.yaml")
    assert config.learn == dataclasses.replace(dj.load_learn_config("rc"), seed=5) and config.training == 2
    assert complete_tune_config({"learn": {"car": "sedan"}}, "c.yaml", "rc").learn == dj.load_learn_config("rc")


@pytest.mark.parametrize("options", [{"learn": [1]}, {"learn": {"plnts": 3}}, {"learn": {"plants": "many"}}])
def test_a_bad_key_of_a_tuning_is_named_with_its_file(options):
    with pytest.raises(BadInput, match=r"^c\.yaml: key 'learn'"):
        complete_tune_config(options, "c.yaml")


def test_a_bad_key_is_named_with_its_file(partial):
    for load in (dj.load_learn_config, dj.load_plan_config):
        with pytest.raises(BadInput, match=r"c\.yaml: unknown key 'plnts'"):
            load(partial("plnts: 3\n"))
