"""The stages of a run: which there are, what candidates and layers the options ask for."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.core.config import to_dict
from driftjax.learning import explore
from driftjax.learning.config import ExploreConfig, load_learn_config
from driftjax.learning.explore import choose, offset
from driftjax.learning.metrics import LapFigures
from driftjax.learning.model import empty
from driftjax.learning.reference import AIM_POINTS
from driftjax.learning.run import _resume
from driftjax.learning.scenario import build_drivers, build_scenario
from driftjax.learning.stage import CODES, StageResult, run_stage, stage_values
from driftjax.learning.stages import _layers, drive_stage, first_progress, stage_names
from driftjax.learning.updates import update_progress
from driftjax.parallel import BatchExecutor
from driftjax.sim import LapCode, Laps
from driftjax.store import RunFolder
from driftjax.store.variables import dataset
from driftjax.vehicle import Residual

SEDAN = load_learn_config("sedan").nothing_learnt  # the car without free parameters compiles sooner
SHORT = dataclasses.replace(SEDAN, plants=2, lap=dataclasses.replace(SEDAN.lap, time_limit=1.0))


@pytest.fixture(scope="module")
def scenario():
    return build_scenario(SHORT, BatchExecutor())


def candidates(scenario, trace, residual, aimed, number):
    """Candidates after laps at the planned speed."""
    planned = jnp.full(2, scenario.corner.V_b)
    return explore.candidates(scenario, trace, residual, aimed, planned, number)


def remaining(scenario, sets, index, aimed, better, trace, residual, number):
    """Candidates after laps at speeds 0.2 m/s below the planned one."""
    current = jnp.full(2, scenario.corner.V_b - 0.2)
    return explore.remaining(scenario, sets, index, aimed, current, better, trace, residual, number)


def exploring(scenario, **changes):
    options = dataclasses.replace(scenario.config.explore, **changes)
    return dataclasses.replace(scenario, config=dataclasses.replace(scenario.config, explore=options))


def test_there_are_as_many_exploration_laps_as_asked_for_and_none_without_sets():
    names = lambda **explore: stage_names(dataclasses.replace(SEDAN, explore=ExploreConfig(**explore)))
    assert names(num_sets=6, laps=2)[-3:] == ["explore-1", "explore-2", "explore-best"]
    assert names(num_sets=2, laps=5)[-3:] == ["explore-4", "explore-5", "explore-best"]
    assert names(num_sets=0)[-1] == "gpr-best"


def test_plants_are_numbered_on_and_keep_their_noise(scenario):
    later = build_scenario(dataclasses.replace(SHORT, first_plant=1, plants=1), BatchExecutor())
    assert later.batch[0] == scenario.batch[1]
    assert bool(jnp.all(later.keys[0] == scenario.keys[1]))


@pytest.fixture(scope="module")
def pursued(scenario):
    """A lap of pure pursuit, and what is known before it."""
    residual = scenario.over_batch(empty(SHORT.gp, nominal=scenario.nominal).residual)
    table = scenario.over_batch(scenario.table)
    return run_stage(scenario, build_drivers(scenario, "pursuit", table, residual), 0).laps.trace, residual


def test_speeds_to_compare_with_lie_within_the_widest_bound(scenario, pursued):
    trace, residual = pursued
    path = jnp.zeros((2, AIM_POINTS))
    V_b, most = scenario.corner.V_b, scenario.corner.V_b * SHORT.explore.gamma_share
    sets = {speeds: candidates(exploring(scenario, speeds=speeds), trace, residual, path, 4)
             for speeds in ("random", "uniform", "planned", "sets")}  # fmt: skip
    at = {speeds: np.asarray(one.V_ep) for speeds, one in sets.items()}
    widest = np.asarray(sets["uniform"].widest)[:, None]
    assert np.all(widest > 0) and np.all(widest <= most * (1 + 1e-12))
    assert np.all(at["planned"] == V_b)
    change = sets["sets"].V - sets["sets"].origin[:, None]
    np.testing.assert_allclose(at["sets"] - V_b, change.mean(axis=2), atol=1e-9)  # curves that change nothing: V_b
    np.testing.assert_allclose(at["uniform"], V_b + widest * [0, -1, 1], rtol=1e-12)
    assert np.all(np.abs(at["random"] - V_b) < widest) and len(np.unique(at["random"])) == 6
    assert np.all(np.diff(np.abs(at["random"] - V_b), axis=1) > 0)  # nearest first
    again, later = (candidates(exploring(scenario, speeds="random"), trace, residual, path, n).V_ep for n in (4, 5))
    assert np.all(at["random"] == np.asarray(again)) and not np.any(np.isin(later, again))
    parents = [jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0) for key in scenario.keys]
    shares = (at["random"] - V_b) / widest
    assert np.all(np.abs(shares - np.asarray(parents)) > 1e-6)  # a key with children of its own draws nothing
    same = [offset(scenario, one, jnp.asarray([0, 2])) for one in sets.values()]
    assert np.any(same[0]) and all(np.all(one == same[0]) for one in same)  # all kinds are offered the same corrections


@pytest.mark.parametrize("speeds", ["sets", "planned"])
def test_the_correction_moves_the_aimed_path_against_the_error_or_not_at_all(scenario, pursued, speeds):
    trace, residual = pursued
    aimed, first = jnp.full((2, AIM_POINTS), 0.1), jnp.asarray([0, 0])
    off, on = (exploring(scenario, speeds=speeds, correction=correction) for correction in (False, True))
    proposed = candidates(on, trace, residual, aimed, 4)
    assert np.all(np.asarray(proposed.V_ep) == np.asarray(candidates(off, trace, residual, aimed, 4).V_ep))
    assert np.all(offset(off, proposed, first) == aimed)
    moved = np.asarray(offset(on, proposed, first) - aimed)
    assert np.any(moved) and np.all(moved * np.asarray(proposed.e) <= 0)


def test_at_the_planned_speed_corrections_grow_until_no_candidate_is_left(scenario, pursued):
    (trace, residual), planned = pursued, exploring(scenario, speeds="planned")
    proposed, order = candidates(planned, trace, residual, jnp.zeros((2, AIM_POINTS)), 4), []
    for _ in range(3):
        index, V, left = choose(planned, proposed, residual)
        order.append(np.asarray(index).tolist())
        assert np.all(V == scenario.corner.V_b) and np.all(left)
        proposed = remaining(planned, proposed, index, proposed.aimed, jnp.zeros(2, bool), trace, residual, 5)
    assert order == [[0, 0], [1, 1], [2, 2]] and not np.any(choose(planned, proposed, residual)[2])


def test_fixed_laps_offer_every_candidate_and_drive_on_when_none_is_left(scenario, pursued, monkeypatch):
    trace, residual = pursued
    still = trace._replace(sensed=trace.sensed._replace(e=jnp.zeros_like(trace.sensed.e)))  # no error: equal speeds
    path = jnp.zeros((2, AIM_POINTS))
    shipped, fixed = (exploring(scenario, fixed_laps=fixed) for fixed in (False, True))
    assert np.asarray(candidates(shipped, still, residual, path, 4).visited).tolist() == [[False, True, True]] * 2
    assert not np.any(candidates(fixed, still, residual, path, 4).visited)

    class Planning(Exception):
        """Raised where a lap is about to be planned."""

    def plan_reference(*_):
        raise Planning

    monkeypatch.setattr("driftjax.learning.stages.plan_reference", plan_reference)
    none_left = first_progress(scenario)
    assert drive_stage(shipped, none_left, "explore-1", 5) is None
    with pytest.raises(Planning):
        drive_stage(fixed, none_left, "explore-1", 5)


def test_a_later_set_aims_at_more_of_the_error_and_never_beyond_it(scenario):
    e = jnp.tile(0.3 * jnp.sin(jnp.linspace(0, 3, 40)), (2, 1)).at[1, 7].set(50.0)  # entry 1 was lost there
    proposed = eqx.tree_at(lambda c: (c.e, c.aimed), first_progress(scenario).candidates, (e, jnp.full_like(e, 0.1)))
    aimed = [np.asarray(offset(scenario, proposed, jnp.asarray([k, k]))) for k in range(3)]
    for k in range(3):
        np.testing.assert_allclose(aimed[k][0], 0.1 - (k + 1) / 3 * e[0], rtol=1e-12)
    most = SHORT.explore.gamma_share * scenario.corner.V_b / abs(scenario.corner.r_b)
    assert aimed[2][1, 7] == pytest.approx(0.1 - most)


def test_a_better_lap_makes_new_sets_about_it_and_any_other_takes_one_away(scenario, pursued):
    trace, residual = pursued
    proposed = candidates(scenario, trace, residual, jnp.zeros((2, AIM_POINTS)), 4)
    aimed, better = jnp.full((2, AIM_POINTS), 0.2), jnp.asarray([True, False])
    none = eqx.tree_at(
        lambda c: (c.e, c.visited), proposed, (jnp.zeros_like(proposed.e), jnp.zeros_like(proposed.visited))
    )
    rest = remaining(scenario, none, jnp.asarray([1, 1]), aimed, better, trace, residual, 5)
    assert np.all(np.asarray(rest.aimed[0]) == 0.2) and np.all(np.asarray(rest.e[0]) == np.asarray(proposed.e[0]))
    assert np.all(np.asarray(rest.visited[0]) == np.asarray(proposed.visited[0]))
    assert not np.any(rest.aimed[1]) and np.asarray(rest.visited[1]).tolist() == [False, True, False]
    assert np.all(rest.current == scenario.corner.V_b - 0.2)  # better or not: Algorithm 1 updates its reference
    same = exploring(scenario, speeds="planned")  # renewed in the same way
    rest = remaining(same, none, jnp.asarray([0, 0]), aimed, better, trace, residual, 5)
    assert np.asarray(rest.visited).tolist() == [[False] * 3, [True, False, False]]
    assert np.all(np.asarray(rest.e[0]) == np.asarray(proposed.e[0])) and not np.any(rest.e[1])


def test_the_sets_are_led_by_what_is_measured(scenario, pursued):
    """The error at an arc length of the set is that which was measured there, whatever the car's true place is."""
    trace, residual = pursued
    path = jnp.zeros((2, AIM_POINTS))
    line = jnp.broadcast_to(jnp.linspace(0.0, 200.0, trace.s.shape[1]), trace.s.shape)
    sensed = trace.sensed._replace(s=line, e=0.01 * line)
    for true in (trace.s, trace.s + 30.0):
        proposed = candidates(scenario, trace._replace(sensed=sensed, s=true), residual, path, 4)
        np.testing.assert_allclose(proposed.e, 0.01 * np.broadcast_to(proposed.s, proposed.e.shape), rtol=1e-9)


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


def test_the_arrival_is_measured_or_stays_the_planned_one(scenario, pursued):
    trace, residual = pursued
    sensed = trace.sensed._replace(s=jnp.broadcast_to(jnp.linspace(0.0, 200.0, trace.s.shape[1]), trace.s.shape))
    laps = Laps(trace._replace(sensed=sensed), jnp.full(2, int(LapCode.COMPLETED)), jnp.asarray(SHORT.mpc.dt))
    flat, before = jnp.full(2, 0.5), first_progress(scenario)
    lap = StageResult(
        laps, scenario.over_batch(scenario.table), trace.V, LapFigures(flat, flat, flat, flat, flat > 0, flat)
    )
    for measured in (True, False):
        config = dataclasses.replace(SHORT, measured_arrival=measured)
        after = update_progress(dataclasses.replace(scenario, config=config), before, lap, residual, 1).arrival
        assert np.all(after.laps == measured) and np.all(np.any(after.x != before.arrival.x, axis=1) == measured)


def test_a_run_that_was_judged_by_true_errors_is_refused(scenario, pursued, tmp_path):
    trace, residual = pursued
    table = scenario.over_batch(scenario.table)
    stage = run_stage(scenario, build_drivers(scenario, "pursuit", table, residual), 0)
    data = dataset(stage_values(scenario, stage, "pursuit"), {"codes": CODES})
    folder = RunFolder.create(tmp_path / "old", to_dict(SHORT))
    folder.write_stage("pursuit", data.drop_vars("lateral_error_measured"), b"")
    with pytest.raises(BadInput, match="true lateral error.*start a new run"):
        _resume(scenario, folder)


def test_what_was_learnt_reaches_the_layers_asked_for_and_the_lags_reach_all(scenario):
    one = eqx.tree_at(lambda d: (d.trust_factor, d.lags), empty(SHORT.gp).residual, (jnp.ones(3), jnp.ones(2)))
    learnt = scenario.over_batch(one)

    def knows(d: Residual) -> bool:
        assert bool(jnp.all(d.lags == 1)) and bool(jnp.all(d.trust_factor == d.trust_factor[0, 0]))
        return bool(d.trust_factor[0, 0])

    def models(layers: str) -> tuple[Residual, Residual]:
        return _layers(dataclasses.replace(scenario, config=dataclasses.replace(SHORT, layers=layers)), learnt)

    assert [tuple(map(knows, models(layers))) for layers in ("both", "reference", "mpc", "none")] == [
        (True, True),
        (True, False),
        (False, True),
        (False, False),
    ]
