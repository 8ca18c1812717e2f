"""Fixed cases of the hidden-effects bench on both cars: names, parameter values and verdicts.

The cases were chosen before any was diagnosed: effects and signs by hand, a case's number is its seed. The catalogue is
the small one of `recorded`; a case has six runs of 6 s. How often the diagnosis is right in fresh cases is the subject
of test_hidden_effects_statistics.py.
"""

import dataclasses
import functools

import numpy as np
import pytest
from diagnosis.cases import Fixed, foreign
from diagnosis.recorded import EFFECTS, sedan

from driftjax.parallel import programs
from driftjax.studies.hidden_effects import criteria
from driftjax.studies.hidden_effects.trial import diagnose_case

ERROR, HALF_WIDTH = 0.2, 0.35  # largest error, and largest 95 % interval, of a named parameter [typical sizes]
CASES = (
    Fixed(1, "sedan"),
    Fixed(2, "rc"),
    Fixed(3, "sedan", {"friction_rear": -1.0}),
    Fixed(4, "rc", {"drive_gain": 1.0}),
    Fixed(5, "sedan", {"steer_lag": 1.0}),
    Fixed(6, "rc", {"yaw_inertia": -1.0}),
    Fixed(7, "sedan", {"stiffness_front": 1.0, "gyro_bias": -1.0}),
    Fixed(8, "rc", {"friction_rear": -1.0, "steer_offset": 1.0}),
    Fixed(9, "sedan", {"friction_rear": 1.0}, ("friction_rear",)),
    Fixed(10, "rc", {"steer_lag": 1.0}, ("steer_lag",)),
)
# 5: the same lag and car as in diagnosis/test_diagnose_verb.py; 10: it goes round about, and proposes a manoeuvre
SLOW = (5, 10)


@functools.cache
def result(number: int) -> criteria.Result:
    """The diagnosis of a case."""
    return CASES[number - 1].result()


def of(kind: str) -> list:
    """The cases of a kind, with their car and effects as names of the tests."""
    cases = [one for one in CASES if one.case().condition in kind.split()]
    marks = lambda one: [pytest.mark.slow] if one.number in SLOW else []
    return [pytest.param(one, id="-".join([one.car, *(one.truth or ("nothing",))]), marks=marks(one)) for one in cases]


def test_a_car_of_another_size_compiles_nothing():
    """Horizons and windows follow sqrt(L/g), and are no shapes. First of the file: results are kept."""
    for number in (1, 7):  # sedans
        result(number)
    before = len(programs._programs)
    for number in (2, 8):  # RC cars
        result(number)
    assert len(programs._programs) == before


@pytest.mark.parametrize("case", of("none"))
def test_nothing_is_named_where_nothing_is_hidden(case):
    assert (result(case.number)["verdict"], result(case.number)["named"]) == ("NOTHING", [])


@pytest.mark.parametrize("case", of("single pair"))
def test_what_was_hidden_is_named_and_measured(case):
    content = result(case.number)
    assert content["verdict"] == "NAMED" and set(content["named"]) == set(case.truth), content["sentence"]
    for cause in content["causes"]:
        assert abs(cause["theta"][0] - case.truth[cause["effect"]]) < ERROR
        assert cause["half_width"][0] < HALF_WIDTH


@pytest.mark.parametrize("case", of("absent"))
def test_what_the_catalogue_lacks_is_not_named_as_something_else(case):
    assert result(case.number)["verdict"] != "NAMED", result(case.number)["sentence"]


@functools.cache
def foreign_cause() -> tuple[float, float]:
    """Height of the centre of mass [m] that moves load, as found in a drive of CommonRoad's drift model and as true."""
    content = foreign(11)
    cause = {one["effect"]: one for one in content["causes"]}["load_transfer_long"]
    return cause["theta"][0] * cause["scale"][0], content["height"]


def test_load_transfer_of_a_simulator_that_is_not_ours_is_named():
    """The nominal car has none; nothing of what else differs doubles the height or makes it vanish."""
    estimated, true = foreign_cause()
    assert 0.5 * true < estimated < 2 * true


@pytest.mark.xfail(
    strict=True, reason="0.84 m found of 0.61 m: the small catalogue lacks what else differs, as wheel spin"
)
def test_the_height_of_the_simulator_that_is_not_ours_is_found_within_15_percent():
    estimated, true = foreign_cause()
    assert estimated == pytest.approx(true, rel=0.15)


@pytest.mark.slow
def test_units_of_mass_and_names_of_runs_change_nothing():
    """Grams and millinewtons for kilograms and newtons; the gain of a fit is a sum of the same numbers."""
    case, runs = CASES[2].case(), CASES[2].runs()
    grams = dataclasses.replace(
        sedan(), **{name: 1000 * getattr(sedan(), name) for name in ("m", "Iz", "Fxr_min", "Fxr_max", "Fxr_rate_max")}
    )
    other = tuple(dataclasses.replace(run, name=f"x{9 - i}", Fxr=1000 * run.Fxr) for i, run in enumerate(runs))
    one, two = result(case.seed), diagnose_case(case, grams, other, EFFECTS, 0)
    assert one["named"] == two["named"] == ["friction_rear"] and one["verdict"] == two["verdict"]
    for a, b in zip(one["causes"], two["causes"], strict=True):
        np.testing.assert_allclose(a["theta"], b["theta"], atol=2e-3)
        assert a["probability"] == pytest.approx(b["probability"], abs=0.01)
