"""The report of a sweep: shares of the variance against the truth, the Pareto front, tables over all runs."""

import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.core.config import to_dict
from driftjax.report.table import aligned
from driftjax.store import RunFolder
from driftjax.sweep.analysis import Analysis, analyse, best_trials, explained_share, sensitivity, to_json
from driftjax.sweep.figures import write_figures
from driftjax.sweep.query import differences, find_laps, read_run
from driftjax.sweep.store import Store
from tests.sweep.test_sweep import config_of, run
from tests.sweep.toy import TOY


def analysis_of(values, objective, second=None):
    fields = {name: {"low": 0.0, "high": 1.0} for name in values}
    config = config_of(fields=fields, design="random")
    second = np.full(len(objective), np.nan) if second is None else second
    return Analysis(config, [str(i) for i in range(len(objective))], values, objective, second, {}, 0)


def test_shares_of_the_variance_are_those_of_ishigami():
    """Of Ishigami's function (a 7, b 0.1) 0.314, 0.442 and 0 by each variable, 0.244 by the first with the third."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-np.pi, np.pi, (6000, 3))
    y = np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    shares = sensitivity(analysis_of({name: x[:, i] for i, name in enumerate("abc")}, y))
    assert shares is not None
    assert shares["a"][0] == pytest.approx(0.314, abs=0.03)
    assert shares["b"][0] == pytest.approx(0.442, abs=0.09)  # eight groups are coarse for two periods
    assert shares["c"][0] == pytest.approx(0.0, abs=0.02)
    assert 0.14 < shares["a with c"][0] < 0.26
    assert shares["a with b"][0] == pytest.approx(0.0, abs=0.03)
    assert shares["a"][1] < shares["a"][0] < shares["a"][2]


def test_noise_explains_nothing_on_average_however_few_the_trials():
    rng = np.random.default_rng(1)
    shares = [explained_share(rng.normal(size=24), rng.integers(0, 8, 24)) for _ in range(400)]
    assert abs(np.mean(shares)) < 0.03


def test_the_front_holds_what_nothing_beats_in_both():
    objective, second = np.array([1.0, 2.0, 2.5, 3.0, 4.0]), np.array([9.0, 5.0, 6.0, np.nan, 1.0])
    assert analysis_of({"x": np.arange(5.0)}, objective, second).front.tolist() == [0, 1, 4]


def test_a_sweep_is_reported_with_figures(tmp_path):
    fields = {"x": {"low": 0.0, "high": 5.0}, "gp.P.0": {"low": 0.1, "high": 10.0, "log": True},
              "kind": ["good", "nan", "raises"], "gp.size": [1, 2]}  # fmt: skip
    config = config_of(fields=fields, design="lhs", num=120)
    run(tmp_path, config)
    analysis = analyse(Store(tmp_path, config, TOY), config)
    assert analysis.status == {"done": 80, "failed": 40} and analysis.num_without == 40 and len(analysis.ids) == 40
    assert np.all(np.diff(analysis.objective) >= 0)
    content = to_json(analysis, sensitivity(analysis))
    best = content["best"][0]
    assert best["objective"] == pytest.approx((best["x"] - 2) ** 2 + 0.1 * best["gp.size"] * best["gp.P.0"])
    assert best["kind"] == "good" and content["sensitivity"]["x"]["share"] > 0.5
    assert aligned(best_trials(content))[0].split() == ["trial", "lateral_error", "lap_time", *fields]
    paths = write_figures(analysis, sensitivity(analysis), tmp_path / "figures")
    assert {path.stem for path in paths} == {
        "main_effects", "interactions", "parallel_coordinates", "pareto", "sensitivity",
    }  # fmt: skip
    assert all(path.stat().st_size > 5000 and path.with_suffix(".pdf").exists() for path in paths)


def test_another_stage_can_be_looked_at(tmp_path):
    config = config_of()
    run(tmp_path, config)
    store = Store(tmp_path, config, TOY)
    first, last = analyse(store, config_of(stage="first")), analyse(store, config)
    np.testing.assert_allclose(first.objective, 2 * last.objective)


def test_all_runs_are_one_table(tmp_path):
    config = config_of(base={"gp": {"size": 4}})
    RunFolder.create(tmp_path / "s", to_dict(config), "sweep")
    run(tmp_path / "s", config)
    columns, rows, num = find_laps(tmp_path, "lateral_error < 1 and \"gp.P.0\" = 1.0 and stage = 'last'", 5)
    assert num == 1 and columns[-1] == "gp.P.0"
    row = dict(zip(columns, rows[0], strict=True))
    assert row["lateral_error"] == pytest.approx(0.4) and row["folder"] == str(tmp_path / "s")
    ids = [row[columns.index("trial")] for row in find_laps(tmp_path, "stage = 'last' and x = 2.0", 8)[1]]
    (a, better), (b, worse) = (read_run(tmp_path, name) for name in ids)
    assert differences(a, b) == [("gp.P.0", 1.0, 3.0)] and differences(a, a) == []
    assert [name for name, *_ in differences(better, worse)] == ["first: lateral_error", "last: lateral_error"]


@pytest.mark.parametrize("condition, words", [("speed > 1", "speed"), ("lateral_error <", "syntax"), ("", "syntax")])
def test_bad_conditions_are_reported(tmp_path, condition, words):
    RunFolder.create(tmp_path / "s", to_dict(config_of()), "sweep")
    run(tmp_path / "s", config_of())
    with pytest.raises(BadInput, match=f"--where: .*{words}"):
        find_laps(tmp_path, condition, 5)


def test_absent_names_are_reported(tmp_path):
    with pytest.raises(BadInput, match="holds no finished run"):
        find_laps(tmp_path, "true", 5)
    RunFolder.create(tmp_path / "s", to_dict(config_of()), "sweep")
    run(tmp_path / "s", config_of())
    with pytest.raises(BadInput, match="zz: is neither a run folder nor a trial"):
        read_run(tmp_path, "zz")
