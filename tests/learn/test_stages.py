"""The stages of a run: which there are, what candidates and layers the options ask for."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import Blocks
from driftjax.learn.config import ExploreConfig, load_learn_config
from driftjax.learn.explore import candidates
from driftjax.learn.model import empty
from driftjax.learn.scenario import build, drivers
from driftjax.learn.stage import run_stage
from driftjax.learn.stages import _layers, stage_names
from driftjax.vehicle import Residual

SEDAN = load_learn_config("sedan")
SHORT = dataclasses.replace(SEDAN, plants=2, lap=dataclasses.replace(SEDAN.lap, time_limit=1.0))


@pytest.fixture(scope="module")
def scenario():
    return build(SHORT, Blocks())


def exploring(scenario, **changes):
    options = dataclasses.replace(scenario.config.explore, **changes)
    return dataclasses.replace(scenario, config=dataclasses.replace(scenario.config, explore=options))


def test_fewer_laps_than_candidates_may_be_explored():
    names = lambda **explore: stage_names(dataclasses.replace(SEDAN, explore=ExploreConfig(**explore)))
    assert names(num_sets=6, laps=2)[-3:] == ["explore-1", "explore-2", "explore-best"]
    assert names(num_sets=2, laps=5)[-3:] == ["explore-1", "explore-2", "explore-best"]
    assert names(num_sets=0)[-1] == "gpr-best"


def test_plants_are_numbered_on_and_keep_their_noise(scenario):
    later = build(dataclasses.replace(SHORT, first_plant=1, plants=1), Blocks())
    assert later.lanes[0] == scenario.lanes[1]
    assert bool(jnp.all(later.keys[0] == scenario.keys[1]))


def test_speeds_to_compare_with_lie_within_the_widest_bound(scenario):
    residual = scenario.over_lanes(empty(SHORT.gp).residual)
    table = scenario.over_lanes(scenario.table)
    trace = run_stage(scenario, drivers(scenario, "pursuit", table, residual), 0).laps.trace
    V_b, widest = scenario.corner.V_b, scenario.corner.V_b * SHORT.explore.gamma_share
    at = {speeds: np.asarray(candidates(exploring(scenario, speeds=speeds), trace, residual).V_ep)
          for speeds in ("random", "uniform", "planned")}  # fmt: skip
    assert np.all(at["planned"] == V_b)
    np.testing.assert_allclose(at["uniform"], np.tile([V_b - widest, V_b, V_b + widest], (2, 1)), rtol=1e-12)
    assert np.all(np.abs(at["random"] - V_b) < widest) and len(np.unique(at["random"])) == 6
    again = candidates(exploring(scenario, speeds="random"), trace, residual)
    assert np.all(at["random"] == np.asarray(again.V_ep))


def test_what_was_learnt_reaches_the_layers_asked_for(scenario):
    learnt = scenario.over_lanes(eqx.tree_at(lambda d: d.gate, empty(SHORT.gp).residual, jnp.ones(3)))
    knows = lambda d: bool(jnp.all(d.gate == 1))

    def asked(layers: str) -> tuple[Residual, Residual]:
        return _layers(dataclasses.replace(scenario, config=dataclasses.replace(SHORT, layers=layers)), learnt)

    assert [tuple(map(knows, asked(layers))) for layers in ("both", "reference", "mpc")] == [
        (True, True),
        (True, False),
        (False, True),
    ]
