"""Learning from options to report: it learns, goes on after a kill, and a batch equals its single laps."""

import dataclasses
import runpy
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.cli import main
from driftjax.cli.console import parse
from driftjax.cli.learn import LearnOptions, defaults
from driftjax.core.config import to_dict
from driftjax.learning.config import load_learn_config
from driftjax.learning.model import empty
from driftjax.learning.run import run
from driftjax.learning.scenario import build_drivers, build_scenario
from driftjax.learning.stage import run_stage
from driftjax.learning.stages import drive_nominal
from driftjax.parallel import BatchExecutor
from driftjax.store import RunFolder

SEDAN = load_learn_config("sedan")
CONFIG = dataclasses.replace(
    SEDAN, plants=2, seed=3, compare=False, gpr_laps=1, explore=dataclasses.replace(SEDAN.explore, laps=1)
)
FLAGS = "--plants 2 --seed 3 --no-compare --gpr-laps 1 --explore.laps 1".split()
EXAMPLE = Path(__file__).parents[2] / "experiments" / "examples" / "learn.py"
STAGES = ["nominal", "gpr-1", "gpr-best", "explore-1", "explore-best"]
quiet = lambda stage, done, of: None


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The run folder that the example leaves, and the command line with it: all stages are there already."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", [str(EXAMPLE), str(path)])
        left = runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert left["run"].laps.lateral_error.dims[0] == "stage"
    assert main(["learn", "--resume", str(path), "--workers", "1"]) == 0
    folder = RunFolder.open(path)
    return folder, folder.read_json("results")


def test_the_example_and_the_verb_leave_a_whole_run_folder(finished, capsys):
    folder, results = finished
    assert folder.config == to_dict(CONFIG) and folder.finished() == STAGES
    assert [stage["name"] for stage in results["stages"]] == STAGES
    page = (folder.path / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/") > 5 and "nominal MPC" in page
    assert folder.read_dataset("plan.nc").attrs["violation"] < 1e-6 and folder.has("laps.nc")
    assert main(["runs", "--root", str(folder.path.parent)]) == 0
    assert "5 stages" in capsys.readouterr().out


def test_flags_give_the_options_of_the_example():
    assert parse(LearnOptions, [*FLAGS], "driftjax learn", LearnOptions(defaults(None, None))).options == CONFIG


def test_laps_are_driven_to_their_end_sideways(finished):
    """Of nothing learnt, and of the best that was: a lap that learns may fail, one lap of data says little.

    How much of the corner a lap with one lap of data slides depends on the last digits, which a drift amplifies.
    """
    _, results = finished
    stages = {stage["name"]: stage["controllers"]["path"] for stage in results["stages"]}
    for name in ("nominal", "gpr-best", "explore-best"):
        assert stages[name]["completed"] == [2, 2] and stages[name]["codes"] == {"COMPLETED": 2}
    assert all(stages[name]["drift_share"]["mean"] >= 0.5 for name in ("nominal", "explore-best"))


def test_learning_and_exploring_pays(finished):
    """Two plants: 0.10 to 0.11 m after exploration, 0.29 m before; one lap with a GP alone need not pay."""
    stages = {stage["name"]: stage["controllers"]["path"] for stage in finished[1]["stages"]}
    for name in ("lateral_error", "lateral_error_measured"):
        assert stages["explore-best"][name]["mean"] < 0.7 * stages["nominal"][name]["mean"]


def _median_deviation(lap) -> np.ndarray:
    return np.median(lap["gp_std"].values[lap["alive"].values], axis=0)


def test_what_was_learnt_is_in_the_laps(finished):
    folder, results = finished
    lap = folder.read_stage("gpr-1")
    assert np.all(lap["reference_found"].values) and np.all(lap["reference_error"].values < 1e-2)
    assert np.all(lap["lags"].values > 0) and np.all(lap["lags"].values <= 0.2)
    later = folder.read_stage("explore-1")["gate"].values
    assert np.all(lap["gate"].values == 0), "one lap of data: the fitted parameters alone"
    assert np.all((later >= 0) & (later <= 1)) and np.any(later > 0.5)
    tuned = lap["tuned"].sel(car_parameter=["friction_front.p", "friction_rear.p"]).values
    assert np.all(tuned != 0) and np.all(np.abs(tuned) < 0.15)
    assert np.all(np.isnan(folder.read_stage("nominal")["gp_std"].values))
    unsure = [_median_deviation(folder.read_stage(name)) for name in ("gpr-1", "explore-1")]
    assert np.all(unsure[0] > unsure[1]) and np.all(unsure[1] > 0), "more laps of data make it surer"
    solved = lap["solved"].values[lap["alive"].values & lap["drifting"].values]
    assert np.mean(solved) > 0.9
    assert np.isfinite([results["summary"]["path"][name] for name in ("nominal", "gpr")]).all()


def test_the_papers_cost_drives_the_corner_sideways():
    """It does so only where every solve starts from the reference: else the front saturates and the speed falls."""
    config = dataclasses.replace(CONFIG, controllers=("paper",))
    stage, planned = drive_nominal(build_scenario(config, BatchExecutor(1)), 0)
    assert bool(jnp.all(planned.converged)) and bool(jnp.all(stage.figures.completed))
    assert float(jnp.min(stage.figures.drift_share)) >= 0.5


@pytest.mark.slow
def test_learning_pays_on_eight_plants(tmp_path):
    """Of single plants it does not always: the lateral error of one can be twice the nominal after one lap."""
    config = dataclasses.replace(CONFIG, plants=8, seed=11)
    folder = RunFolder.create(tmp_path / "many", to_dict(config))
    results = run(config, folder, quiet, 2)
    assert results["summary"]["path"]["gpr"] < results["summary"]["path"]["nominal"]


@pytest.mark.parametrize("num_workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_killed_run_goes_on_to_the_same_bits_with_any_workers(num_workers, finished, tmp_path):
    folder, results = finished
    stages = folder.finished()
    shutil.copytree(folder.path, tmp_path / "killed")
    for name in stages[-2:]:
        for path in (tmp_path / "killed" / "stages").glob(f"[0-9][0-9]_{name}.*"):
            path.unlink()
    (tmp_path / "killed" / "results.json").unlink()
    again = RunFolder.open(tmp_path / "killed")
    assert again.finished() == stages[:-2]
    assert run(CONFIG, again, quiet, num_workers) == results
    for name in stages:
        assert again.read_stage(name).identical(folder.read_stage(name))


@pytest.mark.slow
@pytest.mark.parametrize("batch", [2, 16])
def test_a_batch_equals_its_single_laps(batch):
    """Whole laps: pursuit, switch, drift MPC."""
    scenario = build_scenario(dataclasses.replace(CONFIG, plants=batch), BatchExecutor(1))
    initial = scenario.over_batch(empty(CONFIG.gp, nominal=scenario.nominal).residual)
    everyone = build_drivers(scenario, "mpc", scenario.over_batch(scenario.table), initial)
    drive = lambda executor: run_stage(dataclasses.replace(scenario, executor=executor), everyone, 0).laps.trace
    batch, singles = drive(BatchExecutor(None)), drive(BatchExecutor(1))
    assert jnp.all(jnp.any(batch.decision.drifting, axis=1))
    alive = np.asarray(batch.alive)
    np.testing.assert_array_equal(singles.alive, alive)
    for name in ("V", "beta", "r", "x", "y", "delta"):  # after a lap's end its entry waits for the others
        one, other = (np.asarray(getattr(trace, name))[alive] for trace in (singles, batch))
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)
