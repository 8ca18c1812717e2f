"""The report of a diagnosis from its folder alone: every figure, nothing from elsewhere, nothing where nothing is."""

import re

import numpy as np
import pytest
from diagnosed import DRIVERS, EFFECTS, diagnosed, diagnosis_content
from matplotlib.colors import to_hex
from matplotlib.patches import Rectangle

from driftjax.cli import main
from driftjax.report import closed_loop_table, error_share_table, gain_table, run_line, write_diagnosis
from driftjax.report.diagnosis import TITLES, diagnosis_figures
from driftjax.report.diagnosis_page import diagnosis_page
from driftjax.report.evidence import PLAIN, plot_confusability, plot_scores
from driftjax.report.predictions import plot_error_over_horizon, plot_predictions
from driftjax.report.residuals import plot_residual_forces
from driftjax.report.style import EXPLORED, NOMINAL
from driftjax.store import DIAGNOSIS, RunFolder


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> RunFolder:
    return diagnosed(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(autouse=True)
def closed():
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


def test_page_holds_every_figure_and_needs_nothing_else(run, capsys):
    assert main(["report", str(run.path)]) == 0
    page = (run.path / "report.html").read_text()
    assert str(run.path / "report.html") in capsys.readouterr().out
    names = {path.stem for path in (run.path / "figures").glob("*.png")}
    assert names == set(TITLES) == {path.stem for path in (run.path / "figures").glob("*.pdf")}
    assert page.count("data:image/png;base64,") == len(names)
    assert not re.search(r"(src|href)=['\"]?(http|/|figures)", page), "the page must stand alone"
    for words in ("NAMED", "Rear friction differs &lt;a lot&gt;.", "The lateral force of the rear axle is off most.",
                  "0.80 [0.70, 0.90]", "100 % [90, 100]", "1.50 [1.40, 1.60]",
                  "the log lacks ax, ay", "throttle_steps", "log.csv", "rows: 1000"):  # fmt: skip
        assert words in page, words


def test_several_causes_are_named_together_first_and_each_with_its_equation(tmp_path):
    page = diagnosis_page(diagnosed(tmp_path / "two", named=("friction_rear", "steer_lag")), [])
    assert re.search(r'class="lead">friction_rear and steer_lag together explain \d+ % \[\d+, \d+\] of the error', page)
    assert "mu_r (1 + p)" in page and "tau delta_dot + delta = delta_command" in page
    alone = diagnosis_page(diagnosed(tmp_path / "one"), [])
    assert 'class="lead">Rear friction differs' in alone and "together explain" not in alone


def test_exploratory_causes_are_marked_in_the_table():
    content = diagnosis_content(("friction_rear",))
    assert "exploratory" not in error_share_table(content)
    content["causes"][0]["exploratory"] = True
    assert "friction_rear (exploratory)" in error_share_table(content)


def test_what_is_stored_describes_itself(run):
    data = run.read_dataset("diagnosis.nc")
    assert set(DIAGNOSIS) == set(data.variables)
    for name, variable in data.variables.items():
        assert {"units", "long_name"} <= set(variable.attrs), name


def test_a_diagnosis_that_names_nothing_shows_the_nominal_car_only(tmp_path):
    bare = diagnosed(tmp_path / "bare", named=(), drivers=False)
    assert {name for name, _ in diagnosis_figures(bare)} == set(TITLES) - {
        "posterior", "residual_forces", "tyre_curves", "worth"
    }  # fmt: skip
    data = bare.read_dataset("diagnosis.nc")
    colours = {to_hex(line.get_color()).upper() for axis in plot_predictions(data).axes for line in axis.lines}
    assert NOMINAL in colours and EXPLORED not in colours
    colours = {to_hex(line.get_color()).upper() for axis in plot_error_over_horizon(data).axes for line in axis.lines}
    assert NOMINAL in colours and EXPLORED not in colours


def test_data_that_say_nothing_have_a_page_too(tmp_path):
    run = RunFolder.create(tmp_path / "short", {"vehicle": {"name": "rc"}}, "diagnose")
    run.write_json("diagnosis", {"verdict": "DATA_INSUFFICIENT", "sentence": "The log holds 2.0 s.", "data": {},
                                 "show": None})  # fmt: skip
    page = write_diagnosis(run).read_text()
    assert "DATA_INSUFFICIENT" in page and "2.0 s" in page and "base64" not in page
    assert "done" in run_line(run)


def test_curves_are_those_stored_in_the_units_of_their_axes(run):
    data = run.read_dataset("diagnosis.nc")
    axes = plot_error_over_horizon(data).axes
    beta = next(axis for axis in axes if "sideslip" in axis.get_ylabel())
    assert "[deg]" in beta.get_ylabel()
    nominal = next(line for line in beta.lines if to_hex(line.get_color()).upper() == NOMINAL)
    expected = np.rad2deg(data["rmse"].sel(compared="nominal", channel="beta").values)
    np.testing.assert_allclose(np.asarray(nominal.get_ydata(), float), expected)
    figure = plot_residual_forces(data)
    assert figure is not None
    panels = [axis for axis in figure.axes if axis.lines]
    assert len(panels) == 3 * len(DRIVERS)
    heights = [np.asarray(line.get_ydata(), float) for line in panels[2 * len(DRIVERS) + 1].lines]
    mean = data["bin_mean"].sel(model="nominal", driver="slip_rear", force="Fyr") / 70
    assert any(len(h) == 10 and np.allclose(h, mean) for h in heights)


def test_bars_are_the_scores_largest_first_and_named_ones_red(run):
    data = run.read_dataset("diagnosis.nc")
    predicted, tested = plot_scores(data).axes
    for axis in (predicted, tested):
        bars = [bar for bar in axis.patches if isinstance(bar, Rectangle)]
        widths = [bar.get_width() for bar in bars]
        assert widths == sorted(widths, reverse=True) and len(widths) == len(EFFECTS)
        assert [to_hex(bar.get_facecolor()).upper() for bar in bars[:2]] == [EXPLORED, PLAIN]
    assert any(np.allclose(np.asarray(line.get_xdata(), float), 3.0) for line in tested.lines)
    heat = plot_confusability(data).axes[0]
    assert [label.get_text() for label in heat.get_yticklabels()][0] == "friction_rear.p"


def test_numbers_that_are_missing_are_dashes():
    nothing = {"held_out_runs": [], "horizons_s": [], "rmse": {}, "skill": {}, "ci95": {}}
    assert "not measured" in gain_table(nothing)
    one = {"V": [0.1, None], "beta": [0.1, None], "r": [0.1, 0.2]}
    text = gain_table({"held_out_runs": ["a"], "horizons_s": [0.01, 1.0], "rmse": {"nominal": one, "extended": one},
                       "skill": {"extended": None}, "ci95": {"extended": [None, None]},
                       "ratio": {"extended": [0.5, None]},
                       "ratio_ci95": {"extended": [[0.4, 0.6], [None, None]]}})  # fmt: skip
    assert "nothing to explain" in text and "0.50 [0.40, 0.60]" in text
    assert len(re.findall(r"\s-(?=\s)", text)) == 5 and "nan" not in text and "None" not in text


def laps(*codes: str, **means: float | None) -> dict:
    done = sum(code == "COMPLETED" for code in codes)
    each = {name: {"mean": value, "per_seed": [value] * len(codes)} for name, value in means.items()}
    return {"completed": [done, len(codes)], "codes": list(codes)} | each


def test_closed_loop_is_reported_per_model_with_what_failed(run):
    good = laps("COMPLETED", "COMPLETED", lateral_error=0.08, velocity_rmse=0.4, drift_share=0.7)
    bad = laps("SPUN", "OFF_TRACK", lateral_error=6.0, velocity_rmse=None, drift_share=0.1)
    apart = {"mean": -5.92, "ci95": [-6.5, -5.25], "pairs": 2}
    none = {"mean": None, "ci95": [None, None], "pairs": 0}
    driven = {"plant": "truth.yaml", "corner": "sedan", "controller": "path",
              "models": {"nominal": bad, "extended": good},
              "difference": {"lateral_error": apart, "velocity_rmse": none, "drift_share": apart}}  # fmt: skip
    words = closed_loop_table(driven)
    nominal, extended, less = words.splitlines()[3:6]
    assert "6.000" in nominal and "0/2" in nominal and "spun, off track" in nominal and " - " in nominal
    assert "0.080" in extended and "2/2" in extended and "none" in extended
    assert "-5.920 [-6.500, -5.250]" in less
    driven |= {"models": {"nominal": good, "extended": {"not_driven": "no plan was found."}}, "difference": None}
    assert "extended: not driven; no plan was found." in closed_loop_table(driven)
    run.write_json("diagnosis", run.read_json("diagnosis") | {"closed_loop": driven})
    assert "Closed loop" in write_diagnosis(run).read_text()
