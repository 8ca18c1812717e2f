"""Trials chosen by Optuna: they tend to the optimum, go on after a stop, and are given up where a pruner says so."""

import pytest

from driftjax.core import BadInput
from driftjax.sweep import open_executor, run_trials
from driftjax.sweep.optuna_source import OptunaSource
from driftjax.sweep.store import Store
from tests.sweep.test_sweep import config_of, table
from tests.sweep.toy import TOY

FIELDS = {"x": {"low": -5.0, "high": 9.0}, "gp.size": {"low": 1, "high": 3, "integer": True}}


def run(path, config, workers=0, stop=None):
    path.mkdir(parents=True, exist_ok=True)
    store = Store(path, config, TOY)
    with store.locked():
        source = OptunaSource(config, TOY, store)

        def report(words, done, total):
            if stop is not None and done >= stop:
                raise KeyboardInterrupt

        with open_executor(workers, None) as executed:
            return run_trials(config, TOY, store, source, executed, report)


def test_trials_tend_to_the_optimum_and_a_stopped_sweep_goes_on(tmp_path):
    config = config_of(fields=FIELDS, design="optuna", num=30, seed=1)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, config, stop=12)
    run(tmp_path, config)
    last = [row for row in table(tmp_path) if row["stage"] == "last"]
    assert len(last) == len({row["trial"] for row in last}) == len({row["number"] for row in last}) == 30
    assert min(row["lateral_error"] for row in last[15:]) < 0.3
    near = lambda rows: sum(abs(row["x"] - 2.0) < 2.0 for row in rows)
    assert near(last[20:]) > near(last[:10])
    assert run(tmp_path, config) == {}


def test_a_pruner_ends_trials_after_a_step(tmp_path):
    config = config_of(fields=FIELDS, design="optuna", num=16, pruner="MedianPruner", seed=2)
    counts = run(tmp_path, config, workers=2)
    assert counts["pruned"] > 0 and counts["pruned"] + counts["done"] == 16
    stages: dict[str, set[str]] = {}
    for row in table(tmp_path):
        if row["status"] == "pruned":
            stages.setdefault(row["trial"], set()).add(row["stage"])
    assert {"first"} in stages.values()  # as worse than the median after the first step; others may be after the last


def test_failures_are_reported_to_the_study_and_it_goes_on(tmp_path):
    fields = FIELDS | {"kind": ["raises", "nan"]}
    counts = run(tmp_path, config_of(fields=fields, design="optuna", num=16, sampler="RandomSampler"))
    assert counts["done"] + counts["failed"] == 16 and counts["done"] > 0 and counts["failed"] > 0
    assert run(tmp_path, config_of(fields=fields, design="optuna", num=16, sampler="RandomSampler")) == {}


@pytest.mark.parametrize(
    "options, words",
    [
        ({"sampler": "Best"}, "key 'sampler' is 'Best'; choose one of .*TPESampler"),
        ({"pruner": "Best"}, "key 'pruner' is 'Best'; choose one of .*MedianPruner"),
        ({"sampler": "GridSampler"}, "GridSampler.*search_space"),
        ({"storage": "nonsense://x"}, "key 'storage' is 'nonsense://x': it cannot be opened"),
    ],
)
def test_what_optuna_does_not_know_is_reported(tmp_path, options, words):
    config = config_of(fields=FIELDS, design="optuna", **options)
    with pytest.raises(BadInput, match=words):
        OptunaSource(config, TOY, Store(tmp_path, config, TOY))
