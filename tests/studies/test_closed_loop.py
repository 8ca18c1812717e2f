"""The gain in closed loop: plant and model of each lap, content of the results, one sentence for bad input, and a whole
run."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
import yaml

from driftjax.cli import main
from driftjax.core import BadInput
from driftjax.core.config import to_dict
from driftjax.learning.metrics import LapFigures
from driftjax.learning.scenario import lay_out
from driftjax.logs import Run, write_log
from driftjax.manoeuvres.campaign import Campaign
from driftjax.sim import LapCode
from driftjax.sim.universal_plant import UniversalPlant
from driftjax.store import RunFolder
from driftjax.studies.closed_loop import (
    add_closed_loop,
    closed_loop,
    compare_laps,
    load_case,
    summarise_laps,
    without_estimates,
)
from driftjax.vehicle import DoubleTrack, Extended, actuator_lags, build_car, load_vehicle
from driftjax.vehicle.parameters import EffectParameterValue

SEDAN = dataclasses.replace(load_vehicle("sedan"), combined_slip=1.0)
FOUND = (EffectParameterValue("load_transfer_long", "h", 0.3), EffectParameterValue("steer_lag", "tau", 0.07))
EXTENDED = dataclasses.replace(SEDAN, effects=FOUND)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Every test works in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def truth(**changes) -> str:
    content = {"vehicle": "sedan", "combined_slip": 1.0, "campaign": to_dict(Campaign()),
            "effects": {"load_transfer_long": {"h": 0.3}, "steer_lag": {"tau": 0.07}}}  # fmt: skip
    Path("truth.yaml").write_text(yaml.safe_dump(content | changes))
    return "truth.yaml"


def test_the_plant_is_the_car_that_was_simulated_or_a_double_track():
    case = load_case(Path(truth()), SEDAN)
    car: Any = case.plant
    assert isinstance(car, UniversalPlant) and car.names == ("load_transfer_long", "steer_lag")
    np.testing.assert_allclose(car.theta * car.scale, [0.3, 0.07])
    assert float(car.nominal.combined_slip) == 1.0 and car.step == pytest.approx(0.001)
    assert case.config.batch_size == 4 and case.config.controllers == ("path",)
    assert isinstance(load_case(Path("rc_mu085"), load_vehicle("rc")).plant, DoubleTrack)


def test_the_nominal_car_is_the_extended_one_without_its_values():
    car: Any = build_car(without_estimates(SEDAN, EXTENDED))
    assert isinstance(car, Extended) and car.names == ("load_transfer_long",) and not car.theta.any()
    assert not actuator_lags(without_estimates(SEDAN, EXTENDED)).any() and float(actuator_lags(EXTENDED)[0]) == 0.07
    half = dataclasses.replace(EXTENDED, effects=(FOUND[0], dataclasses.replace(FOUND[1], value=0.03)))
    assert without_estimates(half, EXTENDED).effects == half.effects  # of a car extended before


def driven(errors, speeds, codes):
    done = np.array([code == LapCode.COMPLETED for code in codes])
    each = LapFigures(*map(np.asarray, (errors, errors, speeds, errors, done, errors)))  # pyright: ignore[reportArgumentType]
    return SimpleNamespace(figures=each, laps=SimpleNamespace(code=np.array([int(code) for code in codes])))


def test_a_spin_keeps_its_code_and_is_no_pair_in_speed():
    good, spun = LapCode.COMPLETED, LapCode.SPUN
    one: Any = driven([0.2, 0.3, 8.0, 0.4], [0.5, 0.6, 0.0, 0.4], [good, good, spun, good])
    other: Any = driven([0.1, 0.1, 0.1, 8.0], [0.4, 0.4, 0.4, 0.0], [good, good, good, spun])
    summary = summarise_laps(one)
    assert summary["completed"] == [3, 4] and summary["codes"][2] == "SPUN"
    assert summary["velocity_rmse"]["mean"] == pytest.approx(0.5) and np.isnan(summary["velocity_rmse"]["per_seed"][2])
    assert summary["lateral_error"]["mean"] == pytest.approx(8.9 / 4)
    apart = compare_laps(one, other)
    assert apart["velocity_rmse"]["pairs"] == 2 and apart["velocity_rmse"]["mean"] == pytest.approx(-0.15)
    assert apart["lateral_error"]["pairs"] == 4 and apart["lateral_error"]["mean"] == pytest.approx(-0.6 / 4)


def car(name: str) -> str:
    shipped = {k: v for k, v in dataclasses.asdict(SEDAN).items() if k not in ("effects", "covariance", "noise")}
    Path("car.yaml").write_text(yaml.safe_dump(shipped | {"name": name}))
    return "car.yaml"


def wheels() -> str:
    Path("wheels.yaml").write_text("wheels: 4\n")
    return "wheels.yaml"


BAD = {
    "absent": (lambda: ["--closed-loop", "absent.yaml"], "absent.yaml: no such file"),
    "half a truth": (lambda: ["--closed-loop", truth(effects={"friction": {"p": 0.9}})], "the value lies in"),
    "effects that are none": (lambda: ["--closed-loop", truth(effects=[1])], "truth.yaml: key 'effects' is [1]"),
    "another car": (lambda: ["--closed-loop", truth(), "--vehicle", car("van")], "a car called 'van' is not known"),
    "no plant": (lambda: ["--closed-loop", wheels()], "wheels.yaml: unknown key"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_before_anything_is_diagnosed(case, here, capsys):
    t = np.arange(600) * 0.01
    wave = 0.1 * np.sin(5 * t)
    write_log(Path("log.csv"), [Run("a", t, 10 + wave, wave, wave, wave, 100 * wave, 0.01)])
    arguments, words = BAD[case]
    argv = ["diagnose", "log.csv", "--out", "out", *arguments()]
    assert main(argv) == 2
    output = capsys.readouterr()
    (line,) = output.err.strip().splitlines()
    assert words in line and line.endswith(".") and output.out == "" and not Path("out").exists()


def test_the_car_of_a_vehicle_file_is_a_plant_too(here):
    plant = load_case(Path(car("sedan")), SEDAN).plant
    assert isinstance(plant, UniversalPlant) and plant.names == () and plant.nominal.m == SEDAN.m


@pytest.mark.parametrize("name", ["sedan", "dart"])
def test_every_entry_is_on_the_requested_plant(name):
    """Of a car without plants of its own, such as dart, too."""
    case = load_case(Path(car(name)), load_vehicle(name))
    batch, plants, keys = lay_out(case.config, (case.name, case.plant), 20.0)
    assert [(entry.plant, entry.seed) for entry in batch] == [(case.name, seed) for seed in range(4)]
    assert isinstance(plants, UniversalPlant) and isinstance(case.plant, UniversalPlant)
    np.testing.assert_array_equal(plants.nominal.m, [case.plant.nominal.m] * 4)
    assert len(np.unique(jax.random.key_data(keys), axis=0)) == 4


def test_a_key_that_is_missing_is_named():
    Path("truth.yaml").write_text("vehicle: sedan\n")
    with pytest.raises(BadInput, match="truth.yaml: key 'combined_slip' is missing; give the truth.yaml"):
        load_case(Path("truth.yaml"), SEDAN)


def test_data_that_say_nothing_are_not_driven():
    t = np.arange(200) * 0.01
    wave = 0.1 * np.sin(5 * t)
    write_log(Path("short.csv"), [Run("a", t, 10 + wave, wave, wave, wave, 100 * wave, 0.01)])
    assert main(["diagnose", "short.csv", "--closed-loop", truth(), "--out", "short"]) == 0
    assert json.loads(Path("short/diagnosis.json").read_text())["closed_loop"] is None


def test_the_laps_join_a_saved_diagnosis(here, monkeypatch):
    monkeypatch.setattr(
        "driftjax.studies.closed_loop.closed_loop", lambda *given: {"plant": given[0], "pair": given[1:]}
    )
    folder, diagnosis = RunFolder.create(here / "run", {}, "diagnose"), SimpleNamespace(vehicle="old", extended="new")
    folder.write_json("diagnosis", {"verdict": "NAMED", "closed_loop": None})
    case: Any = "case"
    laps = add_closed_loop(folder, case, diagnosis)  # pyright: ignore[reportArgumentType]
    assert laps == {"plant": "case", "pair": ["old", "new"]}
    assert folder.read_json("diagnosis") == {"verdict": "NAMED", "closed_loop": laps}


@pytest.mark.slow
def test_with_its_effects_in_the_model_the_car_stays_nearer_to_its_plan():
    result = closed_loop(load_case(Path(truth()), SEDAN), SEDAN, EXTENDED)
    assert [one["completed"] for one in result["models"].values()] == [[4, 4], [4, 4]]
    apart = result["difference"]["lateral_error"]
    assert apart["pairs"] == 4 and apart["ci95"][1] < -0.05
