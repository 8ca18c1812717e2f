"""The stages of a run: which there are, what candidates and layers the options ask for."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.core.config import to_dict
from driftjax.learning.config import ExploreConfig, load_learn_config
from driftjax.learning.explore import candidates, offset, remaining
from driftjax.learning.metrics import LapFigures
from driftjax.learning.model import empty
from driftjax.learning.reference import AIM_POINTS
from driftjax.learning.run import _resume
from driftjax.learning.scenario import build, drivers
from driftjax.learning.stage import CODES, StageResult, run_stage, stage_values
from driftjax.learning.stages import _layers, first_progress, stage_names
from driftjax.learning.updates import update_progress
from driftjax.parallel import BatchExecutor
from driftjax.sim import LapCode, Laps
from driftjax.store import RunFolder
from driftjax.store.variables import dataset
from driftjax.vehicle import Residual

SEDAN = load_learn_config("sedan")
SHORT = dataclasses.replace(SEDAN, plants=2, lap=dataclasses.replace(SEDAN.lap, time_limit=1.0))


@pytest.fixture(scope="module")
def scenario():
    return build(SHORT, BatchExecutor())


def exploring(scenario, **changes):
    options = dataclasses.replace(scenario.config.explore, **changes)
    return dataclasses.replace(scenario, config=dataclasses.replace(scenario.config, explore=options))


def test_there_are_as_many_exploration_laps_as_asked_for_and_none_without_sets():
    names = lambda **explore: stage_names(dataclasses.replace(SEDAN, explore=ExploreConfig(**explore)))
    assert names(num_sets=6, laps=2)[-3:] == ["explore-1", "explore-2", "explore-best"]
    assert names(num_sets=2, laps=5)[-3:] == ["explore-4", "explore-5", "explore-best"]
    assert names(num_sets=0)[-1] == "gpr-best"


def test_plants_are_numbered_on_and_keep_their_noise(scenario):
    later = build(dataclasses.replace(SHORT, first_plant=1, plants=1), BatchExecutor())
    assert later.batch[0] == scenario.batch[1]
    assert bool(jnp.all(later.keys[0] == scenario.keys[1]))


@pytest.fixture(scope="module")
def pursued(scenario):
    """A lap of pure pursuit, and what is known before it."""
    residual = scenario.over_batch(empty(SHORT.gp).residual)
    table = scenario.over_batch(scenario.table)
    return run_stage(scenario, drivers(scenario, "pursuit", table, residual), 0).laps.trace, residual


def test_speeds_to_compare_with_lie_within_the_widest_bound(scenario, pursued):
    trace, residual = pursued
    path = jnp.zeros((2, AIM_POINTS))
    V_b, most = scenario.corner.V_b, scenario.corner.V_b * SHORT.explore.gamma_share
    found = {speeds: candidates(exploring(scenario, speeds=speeds), trace, residual, path)
             for speeds in ("random", "uniform", "planned", "sets")}  # fmt: skip
    at = {speeds: np.asarray(one.V_ep) for speeds, one in found.items()}
    widest = np.asarray(found["uniform"].widest)[:, None]
    assert np.all(widest > 0) and np.all(widest <= most * (1 + 1e-12))
    assert np.all(at["planned"] == V_b)
    np.testing.assert_allclose(at["uniform"], V_b + widest * [-1, 0, 1], rtol=1e-12)
    assert np.all(np.abs(at["random"] - V_b) < widest) and len(np.unique(at["random"])) == 6
    again = candidates(exploring(scenario, speeds="random"), trace, residual, path)
    assert np.all(at["random"] == np.asarray(again.V_ep))
    parents = [jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0) for key in scenario.keys]
    drawn = (at["random"] - V_b) / widest
    assert np.all(np.abs(drawn - np.asarray(parents)) > 1e-6)  # a key with children of its own draws nothing
    for speeds in ("random", "uniform", "planned"):
        assert not np.any(offset(scenario, found[speeds], jnp.asarray([0, 2])))  # nothing leads them off the path


def test_a_later_set_aims_at_more_of_the_error_and_never_beyond_it(scenario):
    e = jnp.tile(0.3 * jnp.sin(jnp.linspace(0, 3, 40)), (2, 1)).at[1, 7].set(50.0)  # entry 1 was lost there
    found = eqx.tree_at(lambda c: (c.e, c.aimed), first_progress(scenario).candidates, (e, jnp.full_like(e, 0.1)))
    aimed = [np.asarray(offset(scenario, found, jnp.asarray([k, k]))) for k in range(3)]
    for k in range(3):
        np.testing.assert_allclose(aimed[k][0], 0.1 - (k + 1) / 3 * e[0], rtol=1e-12)
    most = SHORT.explore.gamma_share * scenario.corner.V_b / abs(scenario.corner.r_b)
    assert aimed[2][1, 7] == pytest.approx(0.1 - most)


def test_a_better_lap_makes_new_sets_about_it_and_any_other_takes_one_away(scenario, pursued):
    trace, residual = pursued
    found = candidates(scenario, trace, residual, jnp.zeros((2, AIM_POINTS)))
    aimed, better = jnp.full((2, AIM_POINTS), 0.2), jnp.asarray([True, False])
    none = eqx.tree_at(lambda c: (c.e, c.visited), found, (jnp.zeros_like(found.e), jnp.zeros_like(found.visited)))
    rest = remaining(scenario, none, jnp.asarray([1, 1]), aimed, better, trace, residual)
    assert np.all(np.asarray(rest.aimed[0]) == 0.2) and np.all(np.asarray(rest.e[0]) == np.asarray(found.e[0]))
    assert np.all(np.asarray(rest.visited[0]) == np.asarray(found.visited[0]))
    assert not np.any(rest.aimed[1]) and np.asarray(rest.visited[1]).tolist() == [False, True, False]
    fixed = remaining(exploring(scenario, speeds="planned"), none, jnp.asarray([0, 0]), aimed, better, trace, residual)
    assert np.asarray(fixed.visited).tolist() == [[True, False, False]] * 2


def test_the_sets_are_led_by_what_is_measured(scenario, pursued):
    """The error at an arc length of the set is that which was measured there, whatever the car's true place is."""
    trace, residual = pursued
    path = jnp.zeros((2, AIM_POINTS))
    line = jnp.broadcast_to(jnp.linspace(0.0, 200.0, trace.s.shape[1]), trace.s.shape)
    sensed = trace.sensed._replace(s=line, e=0.01 * line)
    for true in (trace.s, trace.s + 30.0):
        found = candidates(scenario, trace._replace(sensed=sensed, s=true), residual, path)
        np.testing.assert_allclose(found.e, 0.01 * np.broadcast_to(found.s, found.e.shape), rtol=1e-9)


def test_the_best_lap_and_the_last_error_are_the_measured_ones(scenario, pursued):
    """Two laps: the truth prefers the first, the sensors the second."""
    trace, residual = pursued
    progress = first_progress(scenario)
    laps = Laps(trace, jnp.full(2, int(LapCode.COMPLETED)), jnp.asarray(SHORT.mpc.dt))
    table, flat, done = scenario.over_batch(scenario.table), jnp.full(2, 0.5), jnp.ones(2, bool)

    def lap(true: float, measured: float) -> StageResult:
        figures = LapFigures(jnp.full(2, true), flat, flat, flat, done, jnp.full(2, measured))
        return StageResult(laps, table, trace.V, figures)

    first = update_progress(scenario, progress, lap(0.1, 0.3), residual, 1)
    second = update_progress(scenario, first, lap(0.2, 0.2), residual, 2)
    third = update_progress(scenario, second, lap(0.05, 0.25), residual, 3)
    assert np.asarray(first.best.error).tolist() == [0.3, 0.3]
    assert np.asarray(third.best.error).tolist() == [0.2, 0.2] and np.asarray(third.last_error).tolist() == [0.25] * 2


def test_a_run_that_was_judged_by_true_errors_is_refused(scenario, pursued, tmp_path):
    trace, residual = pursued
    table = scenario.over_batch(scenario.table)
    stage = run_stage(scenario, drivers(scenario, "pursuit", table, residual), 0)
    data = dataset(stage_values(scenario, stage, "pursuit"), {"codes": CODES})
    folder = RunFolder.create(tmp_path / "old", to_dict(SHORT))
    folder.write_stage("pursuit", data.drop_vars("lateral_error_measured"), b"")
    with pytest.raises(BadInput, match="true lateral error.*start anew"):
        _resume(scenario, folder)


def test_what_was_learnt_reaches_the_layers_asked_for(scenario):
    learnt = scenario.over_batch(eqx.tree_at(lambda d: d.trust_factor, empty(SHORT.gp).residual, jnp.ones(3)))
    knows = lambda d: bool(jnp.all(d.trust_factor == 1))

    def asked(layers: str) -> tuple[Residual, Residual]:
        return _layers(dataclasses.replace(scenario, config=dataclasses.replace(SHORT, layers=layers)), learnt)

    assert [tuple(map(knows, asked(layers))) for layers in ("both", "reference", "mpc")] == [
        (True, True),
        (True, False),
        (False, True),
    ]
