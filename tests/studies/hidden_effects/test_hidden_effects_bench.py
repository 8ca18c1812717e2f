"""How the hidden-effects bench draws, counts, resumes and draws figures; nothing here is diagnosed."""

import json

import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.studies.hidden_effects import case_runner, criteria
from driftjax.studies.hidden_effects.bench import CASES, StudyConfig, run_study
from driftjax.studies.hidden_effects.case import Case, Hidden, read_case
from driftjax.studies.hidden_effects.draw import DEFAULT, CaseNumbers, draw_cases
from driftjax.studies.hidden_effects.driving_variables import DRIVING_VARIABLES
from driftjax.studies.hidden_effects.figures import write_figures
from driftjax.studies.hidden_effects.foreign_simulator import follow_commands, foreign_vehicle
from driftjax.studies.hidden_effects.score import mean, rate_interval, score_results
from driftjax.vehicle.effect import EFFECTS

SOME = CaseNumbers(none=3, none_noise=2, quiet=4, single=len(DEFAULT), weak=5, pair=6, absent=3, poor=2, std=1, mb=1)


def result(truth=(), causes=(), verdict="NAMED", **more) -> criteria.Result:
    """A result as a bench writes it: `truth` and `causes` are (effect, strength or estimate) with half-width 0.1."""
    effects = tuple(Hidden(name, (size,)) for name, size in truth)
    case = Case(("none", "single", "pair")[len(effects)], "sedan", 1, effects)
    sizes = {name: {"theta": [value], "half_width": [0.1]} for name, value in causes}
    causes = [
        {"effect": n, "probability": 0.9, "p_value": 0.01, "rivals": {}, "scale": [1.0], **v} for n, v in sizes.items()
    ]
    looks = [{"effect": n, "strengths": [s], "T": 9.0, "rank": 0, "alike": {"mass": 0.5}} for n, s in truth]
    return {
        "case": json.loads(case.line()), "group": case.group, "seconds": 2.0, "verdict": verdict, "causes": causes,
        "named": list(sizes), "p_first": 0.3, "p_left": 0.5, "skill": {"extended": [0.5, 0.4, 0.6]},
        "oracle": [0.6, 0.5, 0.7], "unexplained": {"drivers": [], "at_first": []},
        "hidden": [one | sizes.get(one["effect"], {}) for one in looks],
    } | more  # fmt: skip


FOUND = result([("mass", 1.0)], [("mass", 1.05)])
MISSED = result([("mass", 1.0)], [("drive_gain", 1.0)])
NOTHING = result(verdict="NOTHING")


def test_a_plan_is_drawn_again_and_can_be_repeated():
    cases = draw_cases(SOME, ("sedan", "rc"), 5)
    assert cases == draw_cases(SOME, ("sedan", "rc"), 5) != draw_cases(SOME, ("sedan", "rc"), 6)
    assert len(cases) == 2 * (25 + len(DEFAULT)) + 2 and len({case.seed for case in cases}) == len(cases)
    assert [case for case in map(read_case, map(Case.line, cases))] == cases
    full = [c for c in cases if c.condition == "single" and c.scale == 1 and c.process_noise and c.car == "rc"]
    assert sorted(name for case in full for name in case.names) == sorted(DEFAULT)
    for case in cases:
        assert (case.without == case.names) == (case.condition in ("absent", "none", "foreign"))
        for one in case.effects:
            for p, size in zip(EFFECTS[one.name].parameters, one.strengths, strict=True):
                assert p.lower <= size <= p.upper and 0.499 * case.scale <= abs(size) <= 1.501 * case.scale


def test_a_case_becomes_parameters_in_the_order_of_the_catalogue():
    effects = (EFFECTS["mass"], EFFECTS["channel_delay"], EFFECTS["aero_drag"])
    case = Case("pair", "sedan", 0, (Hidden("aero_drag", (0.5,)), Hidden("channel_delay", (1.0, 2.0, 3.0))))
    np.testing.assert_array_equal(case.theta(effects), [0.0, 1.0, 2.0, 3.0, 0.5])


@pytest.mark.parametrize(
    ("line", "word"),
    [("{", "JSON"), ('{"condition": "none"}', "car"), ('{"condition": "none", "car": "std", "seed": 1}', "std"),
     ('{"condition": "single", "car": "rc", "seed": 1, "effects": [{"name": "magic", "strengths": [1]}]}', "magic"),
     ('{"condition": "single", "car": "rc", "seed": 1, "effects": [{"name": "mass", "strengths": []}]}', "mass")],
)  # fmt: skip
def test_a_bad_case_is_reported(line, word):
    with pytest.raises(BadInput, match=word):
        read_case(line)


def test_wilsons_interval():
    np.testing.assert_allclose(rate_interval(5, 10), (0.2366, 0.7634), atol=1e-4)
    np.testing.assert_allclose(rate_interval(0, 10), (0.0, 0.2775), atol=1e-4)
    assert np.isnan(rate_interval(0, 0)).all()


def test_what_counts_as_found():
    assert criteria.named_first(FOUND) and criteria.named_exactly(FOUND) and not criteria.named_first(MISSED)
    small, large = ({name: 0.1 for name in names} for names in (("mass", "cog_shift"), ("mass", "a", "b")))
    for rivals, verdict, right in ((small, "SET", True), (small, "NAMED", False), (large, "SET", False)):
        one = result([("mass", 1.0)], [("drive_gain", 1.0)], verdict)
        one["causes"][0]["rivals"] = rivals
        assert criteria.named_first(one) == right
    two = result([("mass", 1.0), ("aero_drag", 1.0)], [("mass", 1.0), ("aero_drag", 1.0), ("road_bank", 0.1)])
    assert criteria.named_all(two) and not criteria.named_exactly(two)
    assert criteria.interval_hits(FOUND) == [True] and criteria.interval_hits(
        result([("mass", 1.0)], [("mass", 1.2)])
    ) == [False]


def test_the_table_counts_what_it_says():
    wrong = result([("mass", 0.3)], [], "NOTHING")
    wrong["case"]["scale"] = 0.3
    false = result((), [("road_bank", 0.1)])
    worse = result([("mass", 1.0)], [("mass", 1.3)], skill={"extended": [-0.1, -0.2, 0.1]})
    failed = {"case": FOUND["case"], "group": "single sedan", "error": "ValueError: no"}
    table = score_results([FOUND, FOUND, MISSED, NOTHING, NOTHING, NOTHING, false, wrong, worse, failed])
    value = lambda name: (table[f"sedan: {name}"].value, table[f"sedan: {name}"].n)
    assert (table["failed"].value, table["failed"].n) == (1, 10)
    assert value("nothing hidden: named something") == (0.25, 4)
    assert value("one: named first") == (0.75, 4)
    assert value("one at 0.3: named first") == (0, 1)
    assert value("95 % intervals: coverage") == (pytest.approx(2 / 3), 3)
    assert value("share of the explainable removed")[0] == pytest.approx((3 * 0.5 / 0.6 - 0.1 / 0.6) / 4)
    assert value("named, yet worse on runs held out") == (0.25, 4)
    assert value("calibration error of the probability")[0] == pytest.approx(0.9 - 0.75)
    assert "sedan: two: both found" not in table
    unknown = result([("mass", 1.0)], [("mass", 1.0)], "UNKNOWN")
    table = score_results([FOUND, MISSED, unknown])
    assert value("one (all of these): exactly that") == (pytest.approx(2 / 3), 3)
    assert value("one (all of these): named alone, verdict NAMED") == (pytest.approx(1 / 3), 3)
    assert value("one (all of these): said UNKNOWN beside") == (pytest.approx(1 / 3), 3)


def test_a_manoeuvre_that_settles_a_set_and_an_exact_imitation_are_counted():
    of = lambda one, condition, **more: one | {"case": one["case"] | {"condition": condition}} | more
    unsure = of(result([("mass", 1.0)], [("mass", 1.0)], "SET"), "poor")
    rows = [unsure | {"after": after} for after in (FOUND, MISSED, FOUND | {"verdict": "SET"})]
    missing = [of(MISSED, "absent", prices={"named": cost, "truth": 200.0}) for cost in (209.0, 211.0)]
    table = score_results([*rows, of(MISSED, "poor"), *missing])
    value = lambda name: (table[f"sedan: {name}"].value, table[f"sedan: {name}"].n)
    assert value("poor log, SET: resolved by the manoeuvre proposed") == (pytest.approx(1 / 3), 3)
    assert value("poor log: named something else") == (0.25, 4)
    assert value("absent from the catalogue: not NAMED") == (0, 2)
    assert value("absent: named what fits as well as the truth") == (0.5, 2)


def test_a_stopped_bench_goes_on_and_a_case_that_fails_is_kept(monkeypatch, tmp_path, capsys):
    ran: list[int] = []

    def fake(case: Case) -> criteria.Result:
        ran.append(case.seed)
        if case.condition == "absent":
            raise ValueError("no such luck")
        return NOTHING | {"case": json.loads(case.line())}

    monkeypatch.setattr(case_runner, "run_case", fake)
    numbers = CaseNumbers(none=4, none_noise=0, quiet=0, single=0, weak=0, pair=0, absent=1, poor=0, std=0, mb=0)
    scores = run_study(StudyConfig(numbers, seed=3, workers=1, out=tmp_path / "bench"))
    assert scores["failed"]["value"] == 1 and len(ran) == 5
    path = tmp_path / "bench" / "results.jsonl"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:3]) + "\n")
    run_study(StudyConfig(workers=1, resume=True, out=tmp_path / "bench"))
    assert len(ran) == 7 and len(set(ran)) == 5
    assert sorted(path.read_text().splitlines()) == sorted(lines)
    assert "no such luck" in capsys.readouterr().out
    with pytest.raises(BadInput, match=CASES):
        run_study(StudyConfig(numbers, out=tmp_path / "bench"))


def test_figures_are_drawn_of_what_there_is(tmp_path):
    names = [path.name for path in write_figures([FOUND, MISSED, NOTHING], tmp_path)]
    assert names == ["confusion.png", "reliability.png", "coverage.png", "gain.png"]
    assert all((tmp_path / name).stat().st_size > 5000 for name in names)
    assert write_figures([], tmp_path) == []


def test_every_effect_has_driving_variables():
    assert set(DRIVING_VARIABLES) == set(EFFECTS)


@pytest.mark.parametrize("car", ["std", "mb"])
def test_the_foreign_simulator_drives_as_its_own_parameters_say(car):
    """Half a second: speed gained is drive less what turns the wheels; the steering is that of a neutral car."""
    rows = 50
    x, steered, mass = follow_commands(car, 15.0, np.full(rows, 2.0), np.full(rows, 2.0))
    nominal = foreign_vehicle()
    assert mass == nominal.m
    assert x[-1, 0] - x[0, 0] == pytest.approx(2.0 * 0.49, rel=0.15)
    assert steered[-1] == pytest.approx(2.0 * (nominal.a + nominal.b) / x[-1, 0] ** 2, rel=0.03)
    assert 1.0 < x[-1, 0] * x[-1, 2] < 3.0


def test_means_of_few_values_have_the_interval_of_student():
    three = mean([1.0, 2.0, 3.0])
    assert three.high - three.value == pytest.approx(4.3027 / 3**0.5, rel=1e-4)
    assert mean([1.0, 2.0]).value == 1.5 and np.isnan([mean([1.0, 2.0]).low, mean([5.0]).high]).all()
