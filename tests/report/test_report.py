"""Figures and tables rebuilt from a run folder; failed laps and missing stages stay visible."""

import dataclasses
import re

import numpy as np
import pytest
from matplotlib.colors import to_hex
from synthetic import synthetic_run

from driftjax.report import results_table, write_report
from driftjax.report.laps import best_laps, mean_curve, mean_figure, read_laps
from driftjax.report.learn import learn_figures
from driftjax.report.plan import flagged_spans, plot_states, plot_trajectory
from driftjax.report.shape import outline
from driftjax.report.style import DRIFT, EXPLORED, GPR, NOMINAL
from driftjax.report.table import format_interval, last_errors
from driftjax.report.tracking import plot_lateral_error
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle

PER_CONTROLLER = ("lateral_error", "posture", "velocity", "speed_sets", "gp_data")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> RunFolder:
    return synthetic_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(autouse=True)
def closed():
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


def test_report_holds_every_figure_the_table_and_the_config(run):
    page = write_report(run).read_text()
    names = {path.stem for path in (run.path / "figures").glob("*.png")}
    expected = {f"{name}_{controller}" for name in PER_CONTROLLER for controller in ("path", "paper")}
    assert names == expected | {"comparison", "plan_trajectory", "plan_states"}
    assert {path.stem for path in (run.path / "figures").glob("*.pdf")} == names
    assert page.count("data:image/png;base64,") == len(names)
    assert not re.search(r"(src|href)=['\"]?(http|/|figures)", page), "the page must stand alone"
    assert "Wu et al. 2025" in page and "track: sedan_corner" in page
    assert (run.path / "table.txt").read_text() == results_table(run.read_json("results")) + "\n"


def test_a_run_that_stopped_early_shows_what_it_has(tmp_path):
    short = synthetic_run(tmp_path / "short", plants=1, stages=("nominal", "gpr-1"))
    (short.path / "results.json").unlink()
    names = [name for name, _ in learn_figures(short)]
    assert "lateral_error_path" in names and "velocity_path" in names
    assert not any(name.startswith(("gp_data", "speed_sets", "comparison")) for name in names)
    bare = synthetic_run(tmp_path / "bare", stages=())
    (bare.path / "plan.nc").unlink()
    assert write_report(bare).is_file() and list((bare.path / "figures").glob("*.png")) == []


def test_table_has_a_row_per_stage_and_controller_with_failures_by_code(run):
    results = run.read_json("results")
    lines = results_table(results).splitlines()
    rows = [line for line in lines if re.search(r"\d+/\d+", line)]
    assert len(rows) == sum(len(stage["controllers"]) for stage in results["stages"])
    nominal = [line for line in rows if line.startswith("nominal")]
    assert len(nominal) == 2 and all("2/3" in line and "1 spun" in line for line in nominal)
    cell = results["stages"][2]["controllers"]["path"]["lateral_error"]
    assert f"{cell['mean']:.2f} [{cell['ci95'][0]:.2f}, {cell['ci95'][1]:.2f}]" in nominal[0]
    (reduction,) = [line for line in lines if line.startswith("lateral error, GPR")]
    assert any("In brackets" in line for line in lines) and not any("(n/N)" in line for line in lines)
    assert reduction.split()[-1] == "52.8" and "57.1 [51.1, 63.1]" in reduction


def test_missing_numbers_are_dashes_not_crashes():
    assert format_interval(None) == "-" and format_interval({"mean": None, "ci95": [None, None]}) == "-"
    assert format_interval({"mean": 1.234, "ci95": None}) == "1.23"
    assert format_interval({"mean": 5.9, "ci95": [-423943659.8, 100.0]}, ".1f") == "5.9 [-4.2e+08, 100.0]"
    cell = {"mean": 1.234, "ci95": [1.0, 2.0]}
    assert format_interval(cell | {"plants": 3, "all_plants": 4}) == "1.23 [1.00, 2.00] (3/4)"
    assert format_interval(cell | {"plants": 4, "all_plants": 4}) == "1.23 [1.00, 2.00]"
    assert format_interval({"mean": None, "ci95": [None, None], "plants": 0, "all_plants": 4}) == "-"
    empty = {"lateral_error": {"mean": None, "ci95": [None, None], "per_plant": {"a": None}}, "velocity_rmse": None,
             "drift_share": None, "completed": [0, 2], "codes": {"SPUN": 1, "OFF_TRACK": 1}}  # fmt: skip
    text = results_table({"stages": [{"name": "nominal", "controllers": {"path": empty}}], "summary": {"path": {}}})
    assert "In brackets" not in text and "(n/N)" not in text
    assert "0/2" in text and "1 spun, 1 off track" in text and "nan" not in text.lower().replace("nominal", "")


def test_the_error_of_a_run_is_that_of_its_last_best_stage():
    cell = lambda mean: {"path": {"lateral_error": {"mean": mean}}}
    means = {"nominal": 0.4, "gpr-1": 0.01, "gpr-best": 0.2, "explore-1": 0.02, "explore-best": 0.1, "lqr": 0.05}
    stages = [{"name": name, "controllers": cell(mean)} for name, mean in means.items()]
    assert last_errors({"stages": stages}) == {"path": 0.1}, "not the smallest of all, which noise decides"
    assert last_errors({"stages": stages[:2]}) == {"path": 0.01}


def test_best_laps_are_those_driven_with_the_best_setting(tmp_path):
    run = synthetic_run(tmp_path / "run", plants=2, stages=("nominal", "gpr-1", "gpr-2", "gpr-best"))
    chosen, driven = best_laps(run, "path")["gpr"], read_laps(run.read_stage("gpr-best"), "path")
    assert [lap.lateral_error for lap in chosen] == [lap.lateral_error for lap in driven]


def test_without_that_stage_best_laps_have_the_least_measured_error_of_their_plant(run):
    best = best_laps(run, "path")
    assert {kind: len(laps) for kind, laps in best.items()} == {"nominal": 3, "gpr": 3, "explored": 3}
    for lane, lap in enumerate(best["gpr"]):
        both = [read_laps(run.read_stage(f"gpr-{k}"), "path")[lane] for k in (1, 2)]
        assert {lap.plant} == {one.plant for one in both}
        assert lap.measured_error == min(one.measured_error for one in both)
    first = [read_laps(run.read_stage(f"gpr-{k}"), "path")[0].lateral_error for k in (1, 2)]
    assert best["gpr"][0].lateral_error > min(first), "the true error, which no car knows, would choose another"


def test_laps_that_never_reached_the_section_have_no_part_in_the_mean(run):
    laps = read_laps(run.read_stage("nominal"), "path")
    lost = dataclasses.replace(laps[0], velocity_rmse=float("nan"))
    assert mean_figure([lost, *laps[1:]], "velocity_rmse") == pytest.approx(
        np.mean([lap.velocity_rmse for lap in laps[1:]])
    )
    assert np.isnan(mean_figure([lost], "velocity_rmse"))


def test_a_failed_lap_ends_where_it_failed_and_leaves_the_mean_alone(run):
    laps = read_laps(run.read_stage("nominal"), "path")
    assert [lap.code for lap in laps] == ["COMPLETED", "COMPLETED", "SPUN"]
    s = np.linspace(0, 130, 50)
    spun = laps[2].over(s, "e")
    assert np.isnan(spun[s > laps[2]["s"].max()]).all() and np.isfinite(spun[s < laps[2]["s"].max()]).all()
    mean = mean_curve(laps, s, lambda lap, s: lap.over(s, "e"))
    np.testing.assert_allclose(mean, (laps[0].over(s, "e") + laps[1].over(s, "e")) / 2)


def test_lateral_error_curves_are_the_logged_errors_in_the_stages_colours(run):
    plan = run.read_dataset("plan.nc")
    figure = plot_lateral_error(run, plan, "path")
    assert figure is not None
    (axis,) = figure.axes
    lines = [line for line in axis.lines if len(np.atleast_1d(line.get_xdata())) > 100]
    colours = [to_hex(line.get_color()).upper() for line in lines]
    assert {colour: colours.count(colour) for colour in (NOMINAL, GPR, EXPLORED)} == {NOMINAL: 4, GPR: 4, EXPLORED: 4}
    lap = read_laps(run.read_stage("nominal"), "path")[0]
    x, y = (np.asarray(v, float) for v in lines[0].get_data())
    shown = np.isfinite(y)
    np.testing.assert_allclose(y[shown], np.abs(np.interp(x[shown], lap["s"], lap["e"])))
    assert "planned minimum-time path [m]" in axis.get_ylabel()
    assert plot_lateral_error(run, plan, "absent") is None


def test_red_segments_of_the_plan_are_its_drifts(run):
    plan = run.read_dataset("plan.nc")
    red = [line for line in plot_trajectory(plan).axes[0].lines if to_hex(line.get_color()).upper() == DRIFT]
    assert len(red) == 1
    np.testing.assert_array_equal(np.asarray(red[0].get_xdata()), plan["x"].values[plan["drift"].values])
    flags = np.array([1, 1, 0, 0, 1, 0, 1], bool)
    assert flagged_spans(flags, np.arange(7.0)) == [(0, 1), (4, 4), (6, 6)]


def test_a_plan_without_drift_is_drawn_too(run):
    plan = run.read_dataset("plan.nc")
    plan["drift"] = plan["drift"] & False
    assert not [line for line in plot_trajectory(plan).axes[0].lines if to_hex(line.get_color()).upper() == DRIFT]
    assert len(plot_states(plan).axes) == 3


def test_outline_has_the_cars_size_and_heading():
    car = load_vehicle("sedan")
    for psi in (0.0, 0.7, -2.0):
        shape = outline(3.0, -2.0, psi, car) - np.array([3.0, -2.0])
        along = shape @ np.array([np.cos(psi), np.sin(psi)])
        across = shape @ np.array([-np.sin(psi), np.cos(psi)])
        assert np.ptp(along) == pytest.approx(car.length) and np.ptp(across) == pytest.approx(car.width)
        assert (along.max() + along.min()) / 2 == pytest.approx((car.a - car.b) / 2)
        assert np.ptp(across[along > along.max() - 1e-9]) < car.width, "the nose is the narrow end"
