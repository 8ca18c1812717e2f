"""The paper's comparison: which runs it is made of, figures of hand-made laps, targets, tables, figures, the verb."""

import dataclasses
import json
import shutil
from typing import Any

import numpy as np
import pytest
import xarray as xr

from driftjax.cli import main
from driftjax.core import BadInput
from driftjax.core.config import to_dict
from driftjax.learning.config import ExploreConfig
from driftjax.store import RunFolder
from driftjax.studies.paper.ablations import ABLATIONS
from driftjax.studies.paper.arms import EXTENDED, MAIN, arms, settings_hash
from driftjax.studies.paper.config import PaperConfig
from driftjax.studies.paper.extrapolation import extrapolated
from driftjax.studies.paper.figures import write_figures
from driftjax.studies.paper.laps import per_plant
from driftjax.studies.paper.run import start_run
from driftjax.studies.paper.statistics import GAINS, METHODS, paired_gain, summarise_figures, targets
from driftjax.studies.paper.table import paper_page

SECTION = (10.0, 20.0)
SERIES = ("s", "e", "e_ref", "beta", "beta_ref", "r", "r_ref", "V", "delta", "Fxr")


def laps(errors: list[list[float]], completed: list[list[bool]]) -> xr.Dataset:
    """A stage of the paper's controller: `errors` by plant and seed; 31 steps of 1 m, offset 0.5 in the first third of
    the section and 0.2 later, of which the reference asks for 0.1."""
    flat, done = np.ravel(errors), np.ravel(completed)
    num, s = len(flat), np.arange(31.0)
    step = {name: np.zeros((num, 31)) for name in SERIES}
    step["s"] += s
    step["e"] += np.where(s <= 10 + 10 / 3, 0.5, -0.2)
    step["e_ref"] += -0.1
    step["beta"] += -0.5
    step["beta_ref"] += -0.4
    step["r_ref"] += 0.3
    data = {name: (("lane", "step"), values) for name, values in step.items()}
    data |= {
        "alive": (("lane", "step"), np.ones((num, 31), bool)),
        "drifting": (("lane", "step"), np.ones((num, 31), bool)),
    }
    per_lane = {"lateral_error": flat, "lateral_error_max": 2 * flat, "velocity_rmse": flat / 2, "completed": done,
                "drift_share": np.where(flat > 1, 0.4, 0.7)}  # fmt: skip
    names = np.repeat([f"plant_{i}" for i in range(len(errors))], len(errors[0]))
    coords = {"plant": ("lane", names), "controller": ("lane", np.full(num, "paper")), "t": ("step", 0.1 * s)}
    return xr.Dataset(data | {name: ("lane", values) for name, values in per_lane.items()}, coords)


def test_halves_share_no_plant_and_all_else_is_the_same():
    of = {half: arms(PaperConfig(half=half)) for half in ("held_out", "development")}
    for car in ("sedan", "rc"):
        mains = {
            half: next(arm for arm in listed if arm.car == car and arm.name == MAIN) for half, listed in of.items()
        }
        numbers = [set(range(m.learn.first_plant, m.learn.first_plant + m.learn.plants)) for m in mains.values()]
        assert len(numbers[0] | numbers[1]) == 32
        assert len({settings_hash(arm) for arm in mains.values()}) == 1
        assert mains["held_out"].learn.controllers == ("path", "paper") and mains["held_out"].learn.noise_seeds == 2


def test_an_ablation_differs_in_what_it_says_only():
    ablations = [arm for arm in arms(PaperConfig(cars=("rc",))) if arm.name != MAIN]
    assert [arm.name for arm in ablations] == list(ABLATIONS)
    base = to_dict(ablations[0].learn)
    assert ABLATIONS[ablations[0].name][1] == {}
    flat = lambda d, above="": (
        {above + k: v for k, v in d.items() if not isinstance(v, dict)}
        | {key: v for k, d in d.items() if isinstance(d, dict) for key, v in flat(d, f"{above}{k}.").items()}
    )
    for arm in (arm for arm in ablations[1:] if arm.name != EXTENDED):  # whose car is made when it is driven
        new, old = flat(to_dict(arm.learn)), flat(base)
        change = flat(ABLATIONS[arm.name][1])
        apart = {key for key in new if new[key] != old[key]}
        assert apart and apart <= set(change)
        assert len({settings_hash(arm), settings_hash(ablations[0])}) == 2


def test_runs_that_share_laps_differ_in_exploration_only():
    arms_of = {arm.name: arm for arm in arms(PaperConfig(cars=("rc",)))}
    alike = {name: arm.like for name, arm in arms_of.items() if arm.like}
    exploring = ("variance", "nearness", "equal_P", "random", "uniform", "planned", "knowledge_gradient",
                 "expected_improvement", "thompson", "random_grid", "sets_uncorrected")  # fmt: skip
    assert alike == dict.fromkeys((*exploring, "planned_uncorrected"), "rc/as_it_is")
    for name in alike:
        without = [dataclasses.replace(arms_of[one].learn, explore=ExploreConfig()) for one in (name, "as_it_is")]
        assert without[0] == without[1]
        assert arms_of[name].learn.explore.num_sets == arms_of["as_it_is"].learn.explore.num_sets  # of one shape


def test_a_choice_of_arms_needs_no_main_comparison_and_shares_among_its_own():
    chosen = ("planned_uncorrected", "planned", "lags")
    chosen_arms = arms(
        PaperConfig(cars=("rc",), main=False, arms=chosen, ablation_plants=16, ablation_controllers=("path",))
    )
    assert [(arm.name, arm.like) for arm in chosen_arms] == [
        ("lags", None), ("planned", None), ("planned_uncorrected", "rc/planned"),
    ]  # fmt: skip
    assert all(arm.learn.plants == 16 and arm.learn.first_plant == 16 for arm in chosen_arms)
    assert all(arm.learn.controllers == ("path",) and arm.learn.noise_seeds == 1 for arm in chosen_arms)
    bad: list[tuple[dict[str, Any], str]] = [
        ({"arms": ("lag",)}, "names 'lag'; choose among as_it_is"),
        ({"main": False, "ablations": False}, "nothing to drive"),
        ({"arms": ("lags",), "quick": True}, "'quick'"),
        ({"ablation_controllers": ()}, "'ablation_controllers' is empty"),
    ]
    for changes, words in bad:
        with pytest.raises(BadInput, match=words):
            PaperConfig(**changes)


def test_arms_drive_as_many_laps_and_differ_step_by_step():
    """The ladder adds one thing at a time; the square of speed and correction has all else in common."""
    options = {arm.name: arm.learn for arm in arms(PaperConfig(cars=("sedan",)))}
    ladder = [options[name] for name in ("nominal", "lags", "arrival", "gp_reference", "gp_mpc", "as_it_is")]
    assert [(a.gp.lags, a.measured_arrival, a.layers) for a in ladder] == [
        (False, False, "none"), (True, False, "none"), (True, True, "none"),
        (True, True, "reference"), (True, True, "mpc"), (True, True, "both"),
    ]  # fmt: skip
    bare = [dataclasses.replace(a, gp=ladder[0].gp, measured_arrival=True, layers="both", explore=ExploreConfig())
            for a in ladder]  # fmt: skip
    assert all(a == bare[0] for a in bare) and bare[0].converged == 0
    square = [options[name].explore for name in ("planned_uncorrected", "planned", "sets_uncorrected", "as_it_is")]
    assert [(one.speeds, one.correction) for one in square] == [
        ("planned", False), ("planned", True), ("sets", False), ("sets", True),
    ]  # fmt: skip
    rest = [dataclasses.replace(one, speeds="sets", correction=True) for one in square]
    assert all(one == rest[0] for one in rest) and rest[0].fixed_laps


def test_shared_laps_are_those_before_the_candidates_are_made(tmp_path):
    arm = next(arm for arm in arms(PaperConfig(cars=("rc",))) if arm.name == "variance")
    other = RunFolder.create(tmp_path / "rc/as_it_is", {})
    for name in ("nominal", "gpr-1", "gpr-best", "explore-1"):
        other.write_stage(name, laps([[0.2]], [[True]]), name.encode())
    run = start_run(arm, tmp_path, print)
    assert run.finished() == ["nominal", "gpr-1"] and run.read_state("gpr-1") == b"gpr-1"
    assert run.read_stage("gpr-1").identical(other.read_stage("gpr-1")) and run.config == to_dict(arm.learn)


def test_the_extended_car_is_found_once_and_is_all_that_changes(tmp_path, monkeypatch):
    made, said = [], []

    def extend(car, vehicle, folder, report):
        report("naming")
        made.append((car, vehicle.name, vehicle.combined_slip))
        folder.mkdir(parents=True)
        (folder / "extended.yaml").write_text("")

    monkeypatch.setattr("driftjax.studies.paper.run.extend", extend)
    arm, plain = (next(a for a in arms(PaperConfig(cars=("rc",))) if a.name == name) for name in (EXTENDED, "as_it_is"))
    hear = lambda text, done, total: said.append((text, done, total))
    run = start_run(arm, tmp_path, hear)
    shutil.rmtree(run.path)
    assert start_run(arm, tmp_path, hear).config == run.config and made == [("rc", "rc", 1.0)]
    assert said == [("diagnosis, naming", 0, 1)]
    assert run.config == to_dict(plain.learn) | {"vehicle": str(tmp_path / "rc/diagnosis/extended.yaml")}


def test_quick_is_small_and_asks_for_the_main_comparison_only():
    quick = arms(PaperConfig(quick=True).reduced())
    assert [(arm.car, arm.name) for arm in quick] == [("sedan", MAIN), ("rc", MAIN)]
    assert all(arm.learn.plants == 4 and arm.learn.noise_seeds == 1 for arm in quick)


def test_figures_of_a_plant_are_means_over_its_seeds():
    figures = per_plant(laps([[0.2, 0.4], [1.0, 3.0]], [[True, True], [True, False]]), "paper", SECTION)
    np.testing.assert_allclose(figures["lateral_error"], [0.3, 2.0])
    np.testing.assert_allclose(figures["completed"], [1.0, 0.5])
    np.testing.assert_allclose(figures["drifted"], [1.0, 0.5])
    np.testing.assert_allclose(figures["lap_time"], [3.0, 3.0])
    np.testing.assert_allclose(figures["beta_rmse"], 0.1)
    np.testing.assert_allclose(figures["r_rmse"], 0.3)
    np.testing.assert_allclose(figures["entry"], 0.5)
    np.testing.assert_allclose(figures["reference"], 0.1)
    np.testing.assert_allclose(figures["tracking"], (4 * 0.6 + 7 * 0.1) / 11)


def test_a_plant_without_a_completed_lap_has_no_lap_time_and_the_mean_is_of_the_others():
    figures = per_plant(laps([[0.2], [3.0]], [[True], [False]]), "paper", SECTION)
    assert np.isnan(figures["lap_time"][1])
    cell = summarise_figures(figures)["lap_time"]
    assert cell["mean"] == pytest.approx(3.0) and np.isnan(cell["per_plant"][1])


def ends(nominal: float, gpr: float, explored: float, spread: float, num: int = 16):
    """Stages of one controller whose plants differ by `spread`."""
    rng = np.random.default_rng(0)
    make = lambda mean: per_plant(
        laps([[value] for value in mean + spread * rng.normal(size=num)], [[True]] * num), "paper", SECTION
    )
    return {"nominal": make(nominal), "gpr-best": make(gpr), "explore-best": make(explored)}


@pytest.mark.parametrize(
    "value, ci95, met",
    [(60.0, [10.0, 80.0], True), (60.0, [-5.0, 90.0], False), (40.0, [30.0, 50.0], False), (60.0, [None, None], False)],
)
def test_a_gain_is_shown_by_its_size_and_its_interval(value, ci95, met):
    gain = {"value": value, "ci95": ci95}
    rows = ends(0.5, 0.3, 0.2, 0.01)
    gains = {name: gain for name in GAINS}
    rows_of = {row["name"]: row for row in targets("sedan", gains, {"paper": rows})}
    assert rows_of["gpr"]["met"] is met and rows_of["gpr"]["aim"] == 52.8
    assert rows_of["best_error"]["of"] == ("paper", "explore-best") and rows_of["best_error"]["met"]
    assert rows_of["best_error"]["value"] == pytest.approx(float(rows["explore-best"]["lateral_error"].mean()))


def test_gains_are_paired_over_plants():
    rows = ends(0.5, 0.3, 0.2, 0.05)
    rows["gpr-best"]["lateral_error"] = 0.5 * rows["nominal"]["lateral_error"]  # half on every plant: no doubt is left
    gain = paired_gain(rows, "nominal", "gpr-best", "lateral_error")
    assert gain["value"] == pytest.approx(50) and np.ptp(gain["ci95"]) < 1e-9
    assert paired_gain(rows, "nominal", "single-layer", "lateral_error")["value"] is None


def results() -> dict:
    rows = ends(0.5, 0.12, 0.11, 0.02)
    one = paired_gain(rows, "nominal", "gpr-best", "lateral_error")
    gains = {who: {name: one for name in GAINS} for who in ("paper", "path")}
    methods = {who: {name: summarise_figures(stage) for name, stage in rows.items()} for who in ("paper", "path")}
    beyond = {who: {"gpr-best": 0.25} for who in ("paper", "path")}
    small = {"words": "an ablation", "methods": methods, "gains": gains}
    small |= {"diagnosis": {"verdict": "NAMED", "sentence": "The car lacks drag."}}
    car = {"settings": "ab" * 32, "methods": methods, "gains": gains, "extrapolation": beyond}
    car |= {"ablations": {"one": small}, "targets": targets("rc", gains["paper"], {"paper": rows})}
    held = {"exists": 0.5, "steady": 1.0, "speed": [0.95, 0.9, 1.01]}
    car["feasible"] = {"V_b": 3.1, "r_b": 2.7, "paper": held, "path": held}
    car["credit"] = {}
    split = {"seed": 6, "half": "held_out", "plants": list(range(16, 32)), "noise_seeds": 2}
    return {"split": split, "cars": {"rc": car}}


def test_the_page_keeps_rows_that_were_missed_and_tables_are_even():
    words = paper_page(results())
    missed = [line for line in words.splitlines() if line.endswith("| no |")]
    assert any("lateral error of the best method" in line for line in missed)
    assert "Plants 16 to 31 (seed 6, half: held out), 2 noise seeds each" in words and "abababab" in words
    tables = [block.splitlines() for block in words.split("\n\n") if block.startswith("|")]
    assert len(tables) == 5
    assert all(len({line.count("|") for line in lines}) == 1 for lines in tables)
    assert all(name in words for name in (METHODS["gpr-best"], "an ablation", "0.25", "0.950 (0.900 to 1.010)"))
    assert "An ablation, from 60 s of the car that the plants are drawn around: NAMED. The car lacks drag." in words


def test_every_car_has_its_figure(tmp_path):
    content = results()
    bare = content["cars"]["rc"] | {"ablations": {}}
    paths = write_figures({"cars": {"rc": content["cars"]["rc"], "sedan": bare}}, tmp_path)
    assert [path.name for path in paths] == ["statistics_rc.png", "statistics_sedan.png"]
    assert all(path.with_suffix(kind).stat().st_size > 10000 for path in paths for kind in (".png", ".pdf"))


def test_states_far_from_the_data_are_counted(tmp_path):
    data = laps([[0.2], [0.3]], [[True], [True]])
    rng = np.random.default_rng(0)
    Z = rng.normal(size=(2, 30, 5)) * 0.1
    Z[1] += 50.0  # the data of the second entry lie elsewhere
    data = data.assign(gp_Z=(("lane", "point", "feature"), Z), gp_mask=(("lane", "point"), np.ones((2, 30), bool)))
    run = RunFolder.create(tmp_path / "run", {})
    run.write_stage("gpr-best", data, b"")
    assert extrapolated(run, "paper", SECTION) == {"gpr-best": pytest.approx(0.5)}


def test_bad_input_is_reported_in_one_sentence(tmp_path, capsys):
    RunFolder.create(tmp_path / "learn", {}, "learn")
    assert main(["paper", "--resume", str(tmp_path / "learn")]) == 2
    assert "not of `driftjax paper`" in capsys.readouterr().err
    assert main(["paper", "--resume", str(tmp_path / "learn"), "--plants", "3"]) == 2
    assert "leave out every flag" in capsys.readouterr().err
    RunFolder.create(tmp_path / "paper", to_dict(PaperConfig()), "paper")
    assert main(["report", str(tmp_path / "paper")]) == 2
    assert "its main comparison is not finished" in capsys.readouterr().err
    assert main(["paper", "--arms", "lag", "--out", str(tmp_path / "new")]) == 2
    assert "'lag'; choose among" in capsys.readouterr().err and not (tmp_path / "new").exists()
    assert main(["paper", "--plants", "0", "--out", str(tmp_path / "new")]) == 2
    assert "'plants' is 0" in capsys.readouterr().err and not (tmp_path / "new").exists()
    with pytest.raises(BadInput, match="noise_seeds"):
        PaperConfig(noise_seeds=0)


@pytest.mark.slow
def test_a_comparison_goes_on_where_it_stopped(tmp_path):
    out = tmp_path / "paper"
    cfg = dataclasses.replace(PaperConfig(), cars=("sedan",), plants=1, noise_seeds=1, ablations=False)
    options = ["--cars", "sedan", "--plants", "1", "--noise-seeds", "1", "--no-ablations", "--half", "development"]
    assert main(["paper", *options, "--out", str(out), "--workers", "2"]) == 0
    content = json.loads((out / "results.json").read_text())
    assert content["split"]["plants"] == [0] and cfg.first_plant == 1
    run = RunFolder.open(out / "sedan/main")
    stages = run.finished()
    for path in (out / "sedan/main/stages").glob(f"[0-9][0-9]_{stages[-1]}.*"):
        path.unlink()
    (out / "sedan/main/results.json").unlink()
    assert main(["paper", "--resume", str(out), "--workers", "1"]) == 0
    assert json.loads((out / "results.json").read_text()) == content
    (out / "results.md").unlink()
    assert main(["report", str(out)]) == 0 and (out / "results.md").read_text() == paper_page(content)
    assert (out / "figures/statistics_sedan.pdf").exists() and (out / "sedan/main/report.html").exists()
