"""Questions to real logs: how a diagnosis is summarised, which effects are removed from a calibrated car, one run."""

import copy
from pathlib import Path

import pytest
import yaml

from driftjax.core import BadInput
from driftjax.logs.columns import load_columns
from driftjax.studies.model_errors import plot_model_errors
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import effects_by_name
from experiments import real_logs
from experiments.real_logs import QUESTIONS, Config, answer, format_result, main, nominal_car, plant_file

SHARED = Path(__file__).parents[2] / ".." / "shared" / "data"
LOW, STEERING = (next(one for one in QUESTIONS if one.name == name) for name in ("dart_low_grip", "dart_steering"))


def diagnosis(effect: str, parameter: str, value: float, half: float) -> dict:
    """What `diagnosis.json` says of one named effect, and of gains."""
    rmse = {name: {"V": [0.1, size], "beta": [0.01, size], "r": [0.1, 2 * size]}
            for name, size in (("nominal", 2.0), ("retuned", 1.5), ("extended", 0.5))}  # fmt: skip
    gain = {"horizons_s": [0.05, 1.0], "skill_horizon_s": 1.0, "rmse": rmse,
            "skill": {"extended": 0.9}, "ci95": {"extended": [0.8, 0.95]},
            "ratio": dict.fromkeys(("retuned", "extended", "extended_gp"), [0.6, 0.25]),
            "ratio_ci95": dict.fromkeys(("retuned", "extended", "extended_gp"), [[0.5, 0.7], [0.2, 0.3]])}  # fmt: skip
    cause = {"effect": effect, "parameters": {parameter: {"value": value, "ci95": [value - half, value + half]}}}
    return {
        "verdict": "NAMED",
        "sentence": "",
        "causes": [cause],
        "named_by": "single steps",
        "sizes_fitted_to": "likelihood",
        "gain": gain,
        "closed_loop": None,
        "answer_car": "extended",
    }


def test_every_question_asks_for_what_there_is():
    for question in QUESTIONS:
        load_columns(question.columns)
        load_vehicle(question.vehicle)
        names = (*question.expected, *question.forgotten, *(question.calibrated_on or ((), (), ()))[2])
        assert {effect.name for effect in effects_by_name(names)} == set(names)
        assert question.calibrated_on or not question.forgotten


def test_friction_is_relative_to_the_calibrated_car():
    answers = answer(LOW, diagnosis("friction", "p", -0.66, 0.02), {"friction": -0.2})
    one = answers["friction.p"]
    assert one["value"] == pytest.approx(0.425) and one["ci95"] == pytest.approx([0.4, 0.45]) and one["as_known"]
    assert not answer(LOW, diagnosis("friction", "p", -0.4, 0.02), {"friction": -0.2})["friction.p"]["as_known"]
    assert answer(LOW, diagnosis("drive_gain", "p", -0.4, 0.02), {"friction": -0.2}) == {}


def test_results_are_formatted_and_plotted():
    content = diagnosis("steer_lag", "tau", 0.09, 0.01)
    content["answer"] = answer(STEERING, content, {})
    words = format_result(STEERING, content)
    assert "steer_lag.tau = 0.09 [0.08, 0.1]; others: 0.06..0.13" in words and "0.90 [0.80, 0.95]" in words
    assert "extended_gp: error after 1 s on held-out runs, over that of the nominal car: 0.25 [0.20, 0.30]" in words
    laps = {"nominal": {"completed": [0, 4]}, "extended": {"completed": [3, 4]}}
    apart = {"difference": {"lateral_error": {"mean": -0.2, "ci95": [-0.25, -0.15]}}, "models": laps}
    words = format_result(LOW, content | {"closed_loop": apart})
    assert "on the car of dart_slides: nominal 0 of 4, extended 3 of 4; lateral error changes by -0.200" in words
    nothing = copy.deepcopy(content) | {"answer": {}}
    assert "none of them was named" in format_result(STEERING, nothing)
    bars = plot_model_errors({"dart_steering": content["gain"]}).axes[2].containers
    assert [bar.datavalues[0] for bar in bars] == pytest.approx([1.0, 0.75, 0.25])  # pyright: ignore


def test_forgotten_effects_are_removed_from_the_calibrated_car(tmp_path):
    folder = tmp_path / "dart_calibrated"
    folder.mkdir()
    car = yaml.safe_load(Path("configs/vehicle/dart.yaml").read_text())
    effects = {"steer_lag": {"tau": 0.05}, "friction": {"p": -0.2}} | car.pop("effects")
    (folder / "calibrated.yaml").write_text(yaml.safe_dump({"nominal": car, "effects": effects}))
    car = nominal_car(STEERING, Config(out=tmp_path))
    assert {one.effect for one in car.effects} == {"friction", "drive_split", "brake_split"}
    assert load_vehicle(tmp_path / "dart_steering_nominal.yaml") == car
    assert nominal_car(LOW, Config(out=tmp_path)) == load_vehicle(folder / "calibrated.yaml")


def test_unknown_and_premature_questions_are_refused(tmp_path):
    with pytest.raises(BadInput, match=r"question 'moon': choose from dart_slides, .*genesis"):
        main(Config(only=("moon",)))
    assert plant_file(STEERING, Config(out=tmp_path)) is None
    with pytest.raises(BadInput, match="drives on the extended car of 'dart_slides'; answer that one too"):
        plant_file(LOW, Config(out=tmp_path))


@pytest.mark.slow
def test_the_recording_of_the_sedan_shows_its_sensors(tmp_path):
    assert SHARED.is_dir(), "this test needs the measured log of ../shared/data"
    content = real_logs.main(Config(SHARED, ("genesis",), tmp_path))["genesis"]
    value = {name: one["value"] for name, one in content["answer"].items()}
    assert value["sideslip_bias.p"] == pytest.approx(-0.01, abs=0.001)  # as others found
    assert value["gyro_bias.p"] == pytest.approx(0.005, abs=0.001)
    assert value["steer_gain.p"] == pytest.approx(0.1, abs=0.05)
    assert content["verdict"] != "UNKNOWN" and content["gain"]["ci95"]["extended"][0] > 0.5
    assert content["measured"]["created"] and (tmp_path / "real_logs.png").is_file()
