"""A fresh sample of the hidden-effects bench, small enough for every run of the tests, and how the bench counts.

Each run draws new effects, strengths, manoeuvres and noise from a seed that it prints; DRIFTJAX_SEED repeats a run.
The catalogue is the small one of `recorded`, a case some 24 s of data to name from and 12 s held out.
"""

import dataclasses
import functools
import os

import numpy as np
import pytest
from diagnosis.recorded import EFFECTS, NAMES, recorded, sedan

from driftjax.logs import Run
from driftjax.studies.hidden_effects import judged
from driftjax.studies.hidden_effects.bench import Config, main
from driftjax.studies.hidden_effects.case import Case, hidden
from driftjax.studies.hidden_effects.confusion import confusions
from driftjax.studies.hidden_effects.draw import Numbers, plan
from driftjax.studies.hidden_effects.trial import examine

NUMBERS = Numbers(none=8, none_noise=0, quiet=0, single=20, weak=0, pair=6, absent=4, poor=0, std=0, mb=0)
GAIN = 4  # every so-many-th case measures the gain too, which takes as long again
WHOLE = 6  # runs of a recording in which nothing spun


@functools.cache
def seed() -> int:
    given = os.environ.get("DRIFTJAX_SEED")
    return int(given) if given else int(np.random.default_rng().integers(2**31))


def driven(case: Case) -> tuple[Run, ...]:
    """Short runs of a case, all of them whole."""
    rng = np.random.default_rng(case.seed)
    for _ in range(10):
        runs = recorded(case.theta(EFFECTS), *map(int, rng.integers(2**31, size=2)))
        if len(runs) == WHOLE:
            return runs
    raise AssertionError(f"the car spins in every recording of {case.line()}")


@pytest.fixture(scope="module")
def sample():
    """Results of the sample by condition."""
    found: dict[str, list[judged.Result]] = {}
    print(f"DRIFTJAX_SEED={seed()}")
    for i, case in enumerate(plan(NUMBERS, ("sedan",), seed(), tuple(NAMES))):
        result = examine(case, sedan(), driven(case), EFFECTS, 0 if i % GAIN else 3)
        print(f"{case.line()} -> {result['verdict']} {result['named']}, {result['seconds']:.1f} s")
        found.setdefault(case.condition, []).append(result)
    return found


def test_what_was_hidden_is_named(sample):
    """Some 95 % of names are right: fewer than 13 of 20 has p < 1e-3 down to 90 %; a guess is right in 1 of 10."""
    assert sum(map(judged.first, sample["single"])) >= 13, confusions(sample["single"])


def test_both_of_two_are_found(sample):
    """Some 95 %: fewer than 2 of 6 has p < 1e-3 down to 84 %."""
    assert sum(map(judged.both, sample["pair"])) >= 2, confusions(sample["pair"])


def test_nothing_is_named_where_nothing_is_hidden(sample):
    """Chance names something in at most 5 %, 10 % in data as short: 5 of 8 has p < 5e-4."""
    assert sum(map(judged.named, sample["none"])) <= 4, confusions(sample["none"])


def test_an_effect_that_the_catalogue_lacks_is_never_named(sample):
    for result in sample["absent"]:
        assert not set(result["named"]) & set(judged.hidden_in(result))


def test_intervals_hold_the_truth(sample):
    """Nominally 95 %: under 65 % of 20 or more has p < 1e-3 down to 90 %."""
    held = [inside for kind in ("single", "pair") for result in sample[kind] for inside in judged.inside(result)]
    assert np.mean(held) >= 0.65, held


def test_the_extended_car_predicts_better(sample):
    """The share of what the truth would remove, in the middle of all cases in which something was named."""
    shares = judged.shares(sample["single"] + sample["pair"])
    if not shares:
        pytest.skip("in none of the cases whose gain is measured does the truth itself gain beyond doubt")
    assert np.median(shares) > 0.8, shares


def test_the_naive_baseline_fails_where_the_diagnosis_does_not(sample):
    """It is kept to show its bias."""
    assert sum(map(judged.baseline, sample["single"])) < sum(map(judged.first, sample["single"]))


def test_units_of_mass_and_names_of_runs_change_nothing():
    """Grams and millinewtons for kilograms and newtons; the gain of a fit is a sum of the same numbers."""
    case = Case("single", "sedan", seed(), (hidden("drive_gain", 1.0, np.random.default_rng(seed())),))
    print(case.line())
    runs = driven(case)
    grams = dataclasses.replace(
        sedan(), **{name: 1000 * getattr(sedan(), name) for name in ("m", "Iz", "Fxr_min", "Fxr_max", "Fxr_rate_max")}
    )
    other = tuple(dataclasses.replace(run, name=f"x{9 - i}", Fxr=1000 * run.Fxr) for i, run in enumerate(runs))
    one, two = examine(case, sedan(), runs, EFFECTS), examine(case, grams, other, EFFECTS)
    assert one["named"] == two["named"] and one["verdict"] == two["verdict"]
    for a, b in zip(one["causes"], two["causes"], strict=True):
        np.testing.assert_allclose(a["theta"], b["theta"], atol=2e-3)
        assert a["probability"] == pytest.approx(b["probability"], abs=0.01)


@pytest.mark.slow
def test_the_bench_with_the_whole_catalogue(tmp_path):
    """Two cases from draw to score."""
    numbers = Numbers(none=1, none_noise=0, quiet=0, single=1, weak=0, pair=0, absent=0, poor=0, std=0, mb=0)
    scores = main(Config(numbers, workers=1, seed=seed(), out=tmp_path))
    assert scores["failed"]["value"] == 0 and scores["sedan: one: named first"]["n"] == 1
