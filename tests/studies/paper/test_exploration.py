"""Comparison of what chooses the laps: best lap so far, regret, and paired contrasts, by hand."""

from typing import Any

import numpy as np
import pytest

from driftjax.store.variables import dataset
from driftjax.studies.paper.exploration import best_so_far, compare_choosers


class Stages:
    """A run folder with measured and true errors per stage, two plants with two noise seeds each."""

    def __init__(self, measured, true, completed=None):
        self.names = ["nominal", *(f"gpr-{k}" for k in (1, 2)), "gpr-best", "explore-1", "explore-2", "explore-best"]
        self.values = measured, true, np.ones_like(true) if completed is None else completed

    def finished(self):
        return self.names

    def read_stage(self, name):
        k = self.names.index(name)
        measured, true, completed = (np.asarray(v, float)[k] for v in self.values)
        labels = {"plant": np.array(["a", "a", "b", "b"], object), "controller": np.array(["path"] * 4, object)}
        return dataset({"lateral_error_measured": measured, "lateral_error": true, "completed": completed, **labels})


def test_the_best_lap_is_chosen_by_what_is_measured_and_judged_by_the_truth():
    measured = np.full((7, 4), 0.5)
    true = np.arange(28.0).reshape(7, 4)
    measured[2] = 0.4  # the second GP lap is the best before exploration
    measured[4, :2] = 0.3  # the first exploration lap is better on plant a
    measured[5] = 0.1
    completed = np.ones((7, 4))
    completed[5, 3] = 0  # the second is, too, but one car did not finish
    run: Any = Stages(measured, true, completed)
    got = best_so_far(run, "path")
    expected = [[true[2, :2].mean(), true[2, 2:].mean()], [true[4, :2].mean(), true[2, 2:].mean()],
                [true[5, :2].mean(), (true[5, 2] + true[2, 3]) / 2]]  # fmt: skip
    np.testing.assert_array_equal(got, expected)


def test_rules_are_compared_on_the_same_plants():
    ours, other = [[0.2, 0.3], [0.1, 0.1]], [[0.2, 0.3], [0.2, 0.2], [0.0, 0.0]]
    ablations = {"knowledge_gradient": {"best_so_far": {"path": ours}}, "planned": {"best_so_far": {"path": other}},
                 "nominal": {}}  # fmt: skip
    got = compare_choosers(ablations)["path"]
    assert got["against"]["planned"][0]["value"] == 0.0
    assert got["against"]["planned"][1]["value"] == pytest.approx(50.0)
    assert len(got["curves"]["planned"]["error"]) == 2  # as many laps as all have
    assert got["curves"]["planned"]["regret"][1]["mean"] == pytest.approx(0.1)
    assert got["curves"]["knowledge_gradient"]["regret"][1]["mean"] == 0.0
    assert got["best_rival"] == ["planned", "planned"]
    assert compare_choosers({"planned": {"best_so_far": {"path": other}}}) == {}
