"""Rates over many fresh cases of the hidden-effects bench: which share is named, measured and significant.

Run with `-m statistics`. DRIFTJAX_CASES (200) single effects are drawn, a fifth as many logs of nothing, pairs and
effects that the catalogue lacks, half of all on each car, from a seed that is printed; DRIFTJAX_SEED repeats a run.
Rates are appended, with seed, date and commit, as one line of JSON to docs/results/hidden-effects-statistics.jsonl, or
to the file that DRIFTJAX_STATISTICS names. Whoever runs them commits the line: the documentation shows all of them.
"""

import datetime
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnosis.cases import diagnose_runs, runs_without_spin
from diagnosis.recorded import NAMES
from scipy.stats import binom

from driftjax.studies.hidden_effects import criteria
from driftjax.studies.hidden_effects.criteria import confusions
from driftjax.studies.hidden_effects.draw import CaseNumbers, draw_cases

pytestmark = pytest.mark.statistics

CASES = int(os.environ.get("DRIFTJAX_CASES", 200))
ROOT = Path(__file__).parents[3]
SHIPPED = "docs/results/hidden-effects-statistics.jsonl"
OUT = Path(os.environ.get("DRIFTJAX_STATISTICS", ROOT / SHIPPED))
FEWER = CASES // 5  # of the other kinds
RIGHT, WRONG = 0.90, 0.15  # least share of right names, largest of false ones
LEVEL = 0.01  # chance that a kind of few cases fails at its nominal rate


def draw_all(seed: int):
    """Cases on both cars in random order."""
    half, few = CASES // 2, FEWER // 2
    numbers = CaseNumbers(
        none=few, none_noise=0, quiet=0, single=half, weak=0, pair=few, absent=few, poor=0, std=0, mb=0
    )
    return draw_cases(numbers, ("sedan", "rc"), seed, tuple(NAMES))


@pytest.fixture(scope="module")
def sample():
    """Results by condition."""
    seed = int(os.environ.get("DRIFTJAX_SEED", np.random.default_rng().integers(2**31)))
    print(f"DRIFTJAX_SEED={seed} DRIFTJAX_CASES={CASES}")
    measured = origin()  # before the hours that follow, in which files may change
    results_of: dict[str, list[criteria.Result]] = {}
    for case in draw_all(seed):
        result = diagnose_runs(case, runs_without_spin(case))
        print(f"{case.line()} -> {result['verdict']} {result['named']}, {result['seconds']:.1f} s", flush=True)
        results_of.setdefault(case.condition, []).append(result)
    record(measured, seed, results_of)
    return results_of


def origin() -> dict[str, str | bool]:
    """Date, commit, and whether tracked files differ from it; the file of results does not count."""
    git = lambda *words: subprocess.run(["git", *words], capture_output=True, text=True, cwd=ROOT).stdout.strip()
    changes = git("status", "--porcelain", "--untracked-files=no", "--", ".", f":!{SHIPPED}")
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"date": date, "commit": git("rev-parse", "HEAD"), "dirty": bool(changes)}


def record(measured: dict[str, str | bool], seed: int, results_of: dict[str, list[criteria.Result]]) -> None:
    """Append the rates to the file of all runs."""
    line: dict[str, Any] = dict(measured)
    line |= {
        "seed": seed,
        "cases": {kind: len(results) for kind, results in results_of.items()},
        "rates": rates(results_of),
    }
    OUT.parent.mkdir(parents=True, exist_ok=True)
    with OUT.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(line) + "\n")
    print(f"rates: {OUT}")


def rates(results_of: dict[str, list[criteria.Result]]) -> dict[str, float]:
    """Shares of the cases, and of intervals that hold the truth."""
    share = lambda kind, what: float(np.mean([what(result) for result in results_of[kind]]))
    inside = [
        one for kind in ("single", "pair") for result in results_of[kind] for one in criteria.interval_hits(result)
    ]
    return {
        "named first": share("single", criteria.named_first),
        "pair found": share("pair", criteria.named_all),
        "false alarm": share("none", criteria.named_any),
        "absent, not NAMED": share("absent", lambda result: result["verdict"] != "NAMED"),
        "covered": float(np.mean(inside)),
    }


def test_what_was_hidden_is_named(sample):
    """At a true rate of 95 %, 200 cases have fewer than 90 % right with p = 1e-3; at 85 % they do with p = 0.97."""
    assert rates(sample)["named first"] >= RIGHT, confusions(sample["single"])


def test_intervals_hold_the_truth(sample):
    """Nominally 95 %: some 250 intervals hold it in fewer than 90 % with p = 1e-3; at a true 85 % with p = 0.98."""
    assert rates(sample)["covered"] >= RIGHT


@pytest.mark.parametrize(
    ("rate", "nominal"), [("pair found", 0.90), ("absent, not NAMED", 0.85)], ids=["pairs", "absent"]
)
def test_the_rarer_kinds_are_right_as_often_as_is_claimed(sample, rate, nominal):
    """40 cases at the nominal 90 % (85 %) fail with p < 0.01, at 70 % with p = 0.8 (0.4); at 50 % nearly always."""
    assert rates(sample)[rate] * FEWER >= binom.ppf(LEVEL, FEWER, nominal), confusions(sample["pair"])


def test_nothing_is_named_where_nothing_is_hidden(sample):
    """At the nominal 5 %, 40 cases have more than 15 % false alarms with p = 3e-3; at 25 % with p = 0.9."""
    assert rates(sample)["false alarm"] <= WRONG
