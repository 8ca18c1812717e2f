"""Sweeps of a verb that costs nothing: designs, every trial once, kills, damage, two at a time."""

import json
import os
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from driftjax.core import BadInput, from_dict
from driftjax.environment import FUSED_RESULTS
from driftjax.sweep import check, open_executor, run_trials
from driftjax.sweep.config import SweepConfig
from driftjax.sweep.engine import CHUNK_SECONDS
from driftjax.sweep.executors import ChunkExecutor
from driftjax.sweep.source import DesignSource, num_points, points
from driftjax.sweep.store import Store
from driftjax.sweep.trial import objective
from tests.sweep.toy import TOY

GRID = {"x": [0.0, 1.0, 2.0, 3.0], "gp.P.0": [1.0, 3.0]}


def config_of(**options):
    return from_dict(SweepConfig, {"fields": GRID} | options, "test")


def numbered(trials):
    return {"x": [float(i) for i in range(trials)]}


def run(path, config, workers=0, ray=None):
    path.mkdir(parents=True, exist_ok=True)
    store = Store(path, config, TOY)
    with store.locked():
        known, damaged = store.known_trials()
        source = DesignSource(config, TOY, known)
        with open_executor(workers, ray) as executed:
            counts = run_trials(config, TOY, store, source, executed, lambda *_: None)
    return counts, source, damaged


def table(path):
    rows = pq.ParquetDataset(path / "trials").read().to_pylist()
    return sorted(rows, key=lambda row: (row["number"], row["stage"] or ""))


def results(path):
    return [{key: value for key, value in row.items() if key != "seconds"} for row in table(path)]


def test_a_grid_holds_every_combination_and_a_trial_all_options(tmp_path):
    counts, source, _ = run(tmp_path, config_of(base={"gp": {"size": 5}}))
    assert counts == {"done": 8} and source.total == 8
    rows = table(tmp_path)
    assert {(row["x"], row["gp.P.0"]) for row in rows} == {(x, P) for x in GRID["x"] for P in GRID["gp.P.0"]}
    last = [row for row in rows if row["stage"] == "last"]
    assert len(rows) == 16 and len({row["trial"] for row in last}) == 8
    for row in last:
        assert row["lateral_error"] == pytest.approx((row["x"] - 2) ** 2 + 0.5 * row["gp.P.0"])
        assert json.loads(row["config"])["gp"] == {"size": 5, "P": [row["gp.P.0"], 2.0]}


def test_a_sweep_runs_only_what_is_missing(tmp_path):
    trace = tmp_path / "trace"
    some = config_of(fields={"x": [0.0, 1.0]}, base={"trace": str(trace)})
    run(tmp_path / "s", some)
    counts, source, _ = run(tmp_path / "s", config_of(fields={"x": [0.0, 1.0, 5.0]}, base={"trace": str(trace)}))
    assert counts == {"done": 1} and source.num_known == 2
    assert trace.read_text().split() == ["0.0", "1.0", "5.0"]


def test_equal_combinations_are_one_trial(tmp_path):
    counts, source, _ = run(tmp_path, config_of(fields={"x": [1, 1.0, 2.0]}))
    assert counts == {"done": 2} and source.total == 2


OWN = """
from pathlib import Path
from driftjax.sweep import Work
from own_helper import COLUMNS
def complete(options):
    return {"x": 1.0} | options
def files(config):
    return [Path(__file__).with_name("bag")]
def rows(config, blocks, folder):
    return iter([])
WORK = Work(complete, files, rows, COLUMNS)
"""
IDS = """
import os, sys
from driftjax.sweep import SweepConfig
from driftjax.sweep.trial import make_trial
for _ in sys.stdin:  # a process of its own for each id, which imports what is written now
    if os.fork() == 0:
        from own_work import WORK
        print(make_trial(WORK, SweepConfig({"x": [1.0]}), 0, {"x": 1.0}).id, flush=True)
        os._exit(0)
    assert os.wait()[1] == 0
"""


def test_other_source_or_another_file_of_a_folder_is_another_trial(tmp_path):
    """The work's source may lie outside of the package; a ROS 2 bag is a folder."""
    env = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(__file__).parents[2]}"}
    (tmp_path / "bag" / "parts").mkdir(parents=True)

    def written(**texts: str) -> str:
        """The trial's id after these files were written."""
        for name, text in texts.items():
            (tmp_path / NAMES[name]).write_text(text)
        print(file=ids_of.stdin, flush=True)
        assert ids_of.stdout is not None
        return ids_of.stdout.readline()

    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", IDS], env=env, **pipes) as ids_of:
        ids = [written(work=OWN, helper="COLUMNS = {}", part="a"), written(helper="COLUMNS = {'a': float}")]
        ids += [written(work=OWN + "# an edit"), written(part="b"), written(more="")]
        assert len(set(ids)) == len(ids) and all(ids)
        assert written(unused="") == ids[-1]


NAMES = {"work": "own_work.py", "helper": "own_helper.py", "part": "bag/parts/0.db3", "more": "bag/1.db3",
         "unused": "unused.py"}  # fmt: skip


@pytest.mark.parametrize("design", ["random", "lhs"])
def test_designs_fill_their_ranges(design):
    fields = {"x": {"low": 1.0, "high": 100.0, "log": True}, "gp.size": {"low": 1, "high": 4, "integer": True}}
    config = config_of(fields=fields | {"kind": ["good", "nan"]}, design=design, num=400, seed=3)
    design_points = list(points(config))
    assert len(design_points) == num_points(config) == 400 and design_points == list(points(config))
    x = np.array([point["x"] for point in design_points], float)
    assert np.all((x >= 1.0) & (x <= 100.0))
    below = np.sum(x < 10.0)  # half of them, in the logarithm
    assert below == 200 if design == "lhs" else 160 < below < 240
    for size in (1, 2, 3, 4):
        assert 70 < sum(point["gp.size"] == size for point in design_points) < 130
    assert {type(point["gp.size"]) for point in design_points} == {int}


def test_a_random_design_is_the_beginning_of_a_longer_one():
    fields = {"x": {"low": 0.0, "high": 1.0}}
    short, long = (list(points(config_of(fields=fields, design="random", num=n))) for n in (5, 9))
    assert long[:5] == short


def test_what_goes_wrong_in_one_trial_is_reported_and_ends_no_other(tmp_path):
    counts, _, _ = run(tmp_path, config_of(fields={"kind": ["good", "nan", "raises"]}))
    assert counts == {"done": 2, "failed": 1}
    by = {row["kind"]: row for row in table(tmp_path)}
    assert by["raises"]["status"] == "failed" and by["raises"]["lateral_error"] is None
    assert by["raises"]["error"] == "ArithmeticError: the car left the planet"
    text = (tmp_path / "errors" / f"{by['raises']['trial']}.txt").read_text()
    assert "Traceback" in text and "left the planet" in text
    assert by["nan"]["status"] == "done" and by["nan"]["lateral_error"] is None


def test_workers_give_the_same_as_this_process(tmp_path):
    run(tmp_path / "here", config_of())
    run(tmp_path / "beside", config_of(), workers=2)
    assert results(tmp_path / "here") == results(tmp_path / "beside")


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced_and_a_trial_that_kills_every_worker_fails(tmp_path):
    config = config_of(fields={"kind": ["good", "kills", "kills-once"]})
    counts, _, _ = run(tmp_path, config, workers=1)
    assert counts == {"done": 2, "failed": 1}
    assert {(row["kind"], row["status"]) for row in table(tmp_path)} == {
        ("good", "done"), ("kills-once", "done"), ("kills", "failed"),
    }  # fmt: skip


class Breaking(ChunkExecutor):
    """Its pool is found broken at every second submission, before anything of it has begun."""

    submitted, restarted = 0, 0

    @property
    def slots(self):
        return 2

    def submit(self, function, *args):
        self.submitted += 1
        if self.submitted % 2 == 0:
            raise BrokenProcessPool("a worker died")
        return super().submit(function, *args)

    def restart(self):
        self.restarted += 1


def test_a_pool_found_broken_loses_no_trial(tmp_path):
    config = config_of()
    store, executed = Store(tmp_path, config, TOY), Breaking(False)
    counts = run_trials(config, TOY, store, DesignSource(config, TOY, set()), executed, lambda *_: None)
    assert counts == {"done": 8} and executed.restarted > 0
    assert len({row["trial"] for row in table(tmp_path)}) == 8


def test_a_damaged_file_is_set_aside_and_its_trials_run_again(tmp_path):
    config = config_of()
    run(tmp_path, config)
    before, store = results(tmp_path), Store(tmp_path, config, TOY)
    bad = store.parts()[1]
    lost = len({row["trial"] for row in pq.read_table(bad).to_pylist()})
    bad.write_bytes(bad.read_bytes()[:-20])
    counts, _, damaged = run(tmp_path, config)
    assert counts == {"done": lost} and damaged == [tmp_path / "damaged" / bad.name] and damaged[0].exists()
    assert results(tmp_path) == before


def test_two_sweeps_in_one_folder_are_refused(tmp_path):
    store = Store(tmp_path, config_of(), TOY)
    with store.locked(), pytest.raises(BadInput, match="another sweep is writing here"), store.locked():
        pass
    with store.locked():
        pass


@pytest.mark.parametrize(
    "options, words",
    [
        ({"fields": {}}, "key 'fields' is empty"),
        ({"fields": {"x": []}}, "key 'fields.x': the list of values is empty"),
        ({"fields": {"x": 3}}, "key 'fields.x' is 3; give a list of values, or low and high"),
        ({"fields": {"x": {"low": 2.0, "high": 1.0}}, "design": "random"}, "key 'fields.x': key 'low' is 2.0"),
        ({"fields": {"x": {"low": 0.0, "high": 1.0, "log": True}}, "design": "lhs"}, "it must be positive"),
        ({"fields": {"x": {"low": 0.0, "high": 1.0}}}, "key 'fields.x': a grid needs a list"),
        ({"fields": {"x": {"low": 0.5, "high": 2.0, "integer": True}}, "design": "lhs"}, "whole numbers"),
        ({"fields": {"x": [[1]]}}, "must be numbers, words, true or false"),
        ({"num": 0}, "key 'num' is 0"),
        ({"design": "sobol"}, "choose one of grid, random, lhs, optuna"),
        ({"more": 1}, "unknown key 'more'"),
    ],
)
def test_bad_sweeps_are_reported(options, words):
    with pytest.raises(BadInput, match="test: .*" + words.replace("(", r"\(")):
        config_of(**options)


@pytest.mark.parametrize(
    "fields, words",
    [
        ({"y": [1.0]}, "unknown key 'y'"),
        ({"gp.length": [1.0]}, "there is no option 'gp.length': 'length' is unknown; there are size, P"),
        ({"gp.P.7": [1.0]}, "there is no option 'gp.P.7': '7' is unknown; there are 0, 1"),
        ({"x": [1.0, "far"]}, "key 'x' is 'far'"),
    ],
)
def test_fields_that_the_verb_does_not_take_are_reported_before_anything_runs(fields, words):
    with pytest.raises(BadInput, match=words):
        check(config_of(fields=fields), TOY)


def test_a_field_must_not_be_called_as_a_result(tmp_path):
    with pytest.raises(BadInput, match="key 'fields.stage': results have a column of this name"):
        Store(tmp_path, config_of(fields={"stage": ["a"]}), TOY)


def test_the_objective_is_the_mean_over_the_rows_of_a_stage():
    rows = [{"stage": "a", "e": 1.0}, {"stage": "b", "e": 2.0}, {"stage": "b", "e": 4.0}]
    assert objective(rows, "e") == 3.0 and objective(rows, "e", "a") == 1.0
    assert objective([*rows, {"stage": "b", "e": None}], "e") != objective([*rows, {"stage": "b", "e": None}], "e")


CHILD = """
import sys
from pathlib import Path
from tests.sweep.test_sweep import config_of, numbered, run
base = {"pause": float(sys.argv[3]), "trace": sys.argv[1] + "/trace"}
run(Path(sys.argv[1]), config_of(fields=numbered(int(sys.argv[2])), base=base), workers=2)
"""


def killed_until_done(path, moments, trials, pause):
    """Kill the sweep and its workers after each of the moments [s], then let it end."""
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", CHILD, str(path), str(trials), str(pause)]
    for moment in moments:
        process = subprocess.Popen(command, env=env, start_new_session=True)
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    subprocess.run(command, env=env, check=True)
    rows = [row for row in table(path) if row["stage"] == "last"]
    assert [row["x"] for row in rows] == [float(i) for i in range(trials)]
    assert not (path / "damaged").exists()
    begun = (path / "trace").read_text().split()
    most = 2 * max(1, int(CHUNK_SECONDS / pause))  # what the two workers may have had under way
    assert len(begun) <= trials + most * len(moments)


@pytest.mark.slow
def test_killed_sweeps_hold_every_trial_once(tmp_path):
    killed_until_done(tmp_path, (2.5, 4.0), 12, 0.02)


@pytest.mark.slow
def test_a_hundred_kills_lose_nothing(tmp_path):
    killed_until_done(tmp_path, np.random.default_rng(0).uniform(0.5, 7.0, 100), 400, 0.2)


def lost_nodes_change_nothing(path, trials, kills):
    """A sweep on Ray whose second node is killed again and again gives what it gives here."""
    pytest.importorskip("ray")
    run(path / "here", config_of(fields=numbered(trials)))
    command = [sys.executable, "-m", "tests.sweep.on_ray", str(path / "ray"), str(trials), str(kills)]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 0 and f"{kills} nodes killed" in done.stdout, done.stdout + done.stderr[-2000:]
    rows_of = lambda path: [{k: v for k, v in row.items() if k not in ("trial", "config")} for row in results(path)]
    assert rows_of(path / "ray") == rows_of(path / "here")  # its options name the file by which it is seen to begin
    begun = (path / "ray" / "trace").read_text().split()
    assert len(begun) <= trials + 60 * kills  # a chunk of at most 30 on each of two cores is begun again


@pytest.mark.slow
def test_a_ray_cluster_that_loses_a_node_gives_the_same(tmp_path):
    lost_nodes_change_nothing(tmp_path, 12, 1)


@pytest.mark.slow
def test_a_ray_cluster_that_loses_twenty_nodes_gives_the_same(tmp_path):
    lost_nodes_change_nothing(tmp_path, 1000, 20)


@pytest.mark.parametrize("fused", [True, False])
def test_workers_merge_kernels_only_for_work_that_allows_it(monkeypatch, fused):
    monkeypatch.setenv("XLA_FLAGS", "")
    with open_executor(1, None, fused=fused) as workers:
        flags = workers.submit(os.getenv, "XLA_FLAGS").result(timeout=60) or ""
    assert (FUSED_RESULTS in flags.split()) == fused
