"""Vehicle and plant files: bad input is reported in one sentence that names the key."""

import dataclasses
from dataclasses import replace

import pytest
import yaml

from driftjax.core import BadInput
from driftjax.core.config import to_dict
from driftjax.vehicle import load_plant, load_vehicle, with_effects, write_vehicle


@pytest.mark.parametrize(
    ("name", "m", "Iz", "a", "b", "mu", "B", "C"),
    [("sedan", 1835.0, 3234.0, 1.4, 1.65, 1.0, 10.92, 1.458), ("rc", 2.356, 0.0218, 0.122, 0.13, 0.9, 18.1, 1.323)],
)
def test_shipped_cars_are_the_tables_of_the_paper(name, m, Iz, a, b, mu, B, C):
    car = load_vehicle(name)
    assert (car.m, car.Iz, car.a, car.b, car.mu, car.B, car.C) == (m, Iz, a, b, mu, B, C)


@pytest.mark.parametrize(
    ("key", "value"), [("m", -1.0), ("Iz", 0.0), ("C", 0.9), ("delta_max", 40.0), ("Fxr_min", 1e5), ("mu", -0.1)]
)
def test_impossible_vehicle_is_refused_by_key(key, value):
    with pytest.raises(BadInput, match=f"'{key}'"):
        replace(load_vehicle("sedan"), **{key: value})


@pytest.mark.parametrize(
    ("key", "value"),
    [("m", -1.0), ("h", -0.1), ("E", 1.5), ("C", 2.5), ("Fxr_min", 10.0), ("steer_lag", 0.0), ("roll_split", 1.2),
     ("delta_max", 40.0), ("relaxation", float("nan"))],
)  # fmt: skip
def test_impossible_plant_is_refused_by_key(key, value):
    with pytest.raises(BadInput, match=f"'{key}'"):
        dataclasses.replace(load_plant("sedan"), **{key: value})


@pytest.mark.parametrize(("load", "shipped"), [(load_vehicle, "rc"), (load_plant, "rc_mu085")])
def test_files_with_mistakes_are_refused_with_file_and_key(load, shipped, tmp_path):
    with pytest.raises(BadInput, match=shipped):  # the message lists what is shipped
        load("no_such_car")
    path = tmp_path / "car.yaml"
    heavy = yaml.safe_dump(to_dict(load(shipped)) | {"m": "heavy"})
    for text, word in (("mass: 3", "mass"), (heavy, "'m'"), ("- 1", "keys"), ("name: x", "missing")):
        path.write_text(text)
        with pytest.raises(BadInput, match=word) as caught:
            load(path)
        assert "car.yaml" in str(caught.value)


def test_effects_are_added_in_the_order_of_the_catalogue_and_replace_those_of_their_name(tmp_path):
    car = with_effects(load_vehicle("f1tenth"), {"steer_delay": {"d": 0.12}, "drive_split": {"p": 0.4}})
    assert [(one.name, one.value) for one in car.effects] == [
        ("steer_delay.d", 0.12), ("drive_split.p", 0.4), ("brake_split.p", 0.519)
    ]  # fmt: skip
    write_vehicle(tmp_path / "car.yaml", car)
    assert load_vehicle(tmp_path / "car.yaml").effects == car.effects
    with pytest.raises(BadInput, match=r"effects: steer_delay.d is -1.0; the value lies in"):
        with_effects(car, {"steer_delay": {"d": -1.0}})
    with pytest.raises(BadInput, match="no such effect"):
        with_effects(car, {"anvil": {"p": 1.0}})
