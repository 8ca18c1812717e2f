"""References along the sedan's planned corner: the plan as a table, its steady part, the paper's step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import Control, State
from driftjax.learning.reference import entry_horizon, plan_table, steady_corner, step_table
from driftjax.planner import load_plan_config, plan
from driftjax.track import load_track
from driftjax.vehicle import load_vehicle


@pytest.fixture(scope="session")
def lap():
    return plan(load_track("sedan_corner"), load_vehicle("sedan"), load_plan_config("sedan"))


@pytest.fixture(scope="session")
def table(lap):
    return plan_table(lap)


def test_the_table_holds_the_plan_at_its_nodes(lap, table):
    at = jax.jit(jax.vmap(table.state))(lap.S)
    spacing = float(table.spacing)
    for tabled, planned in zip([*at[0], *at[1]], (lap.V, lap.beta, lap.r, lap.delta, lap.Fxr), strict=True):
        slope = np.max(np.abs(np.diff(planned) / np.diff(lap.S)))
        assert np.max(np.abs(np.asarray(tabled - planned))) <= slope * spacing
    assert float(table.start) == 0 and spacing * (len(table.V) - 1) == pytest.approx(float(lap.path.length))


def test_the_reference_runs_along_the_path_it_belongs_to(lap, table):
    assert bool(jnp.all(table.e == 0))
    np.testing.assert_array_equal(table.theta, -table.beta)  # the course is the tangent of the path
    start, end = float(table.drift_start), float(table.drift_end)
    assert (start, end) == lap.drift_interval() and 0 < start < end < float(lap.path.length)
    s = np.asarray(table.start + table.spacing * np.arange(len(table.V)))
    middle = np.abs(s - (start + end) / 2) < (end - start) / 8
    beta, r = np.asarray(table.beta)[middle], np.asarray(table.r)[middle]
    assert np.all(beta * r < 0) and np.all(np.abs(beta) > np.deg2rad(15))
    # course rate V kappa = r + beta_dot, and beta hardly changes in the middle
    course = np.asarray(table.V * table.kappa)[middle]
    assert np.mean(r) == pytest.approx(np.mean(course), rel=0.15)


def test_the_corner_is_the_mean_of_the_planned_middle(table):
    corner = steady_corner(table, 0.44)
    assert corner.V_b == pytest.approx(corner.r_b * corner.R)
    assert np.sign(corner.beta) == -np.sign(corner.R) and abs(corner.beta) == 0.44
    assert float(jnp.min(table.V)) <= corner.V_b <= float(jnp.max(table.V))
    assert 1 / abs(corner.R) <= float(jnp.max(jnp.abs(table.kappa)))


def test_the_step_reference_is_constant_and_keeps_path_and_section(table):
    x = State(*(jnp.asarray(v) for v in (9.0, -0.5, 1.1)))
    u = Control(jnp.asarray(-0.3), jnp.asarray(6800.0))
    step = step_table(table, x, u)
    for name, value in (*x._asdict().items(), *u._asdict().items(), ("theta", 0.5), ("e", 0.0)):
        np.testing.assert_array_equal(getattr(step, name), np.full(table.V.shape, float(value)))
    for name in ("speed", "kappa", "start", "spacing", "drift_start", "drift_end"):
        np.testing.assert_array_equal(getattr(step, name), getattr(table, name))


def test_the_entry_lasts_as_long_as_the_plan_takes_over_it(lap, table):
    S, t = np.asarray(lap.S), np.asarray(lap.t)
    start, end = float(table.drift_start) - 5.0, float(table.drift_end) + 3.0
    taken = np.interp(end, S, t) - np.interp(start, S, t)
    assert entry_horizon(table, 5.0, 3.0, 0.05) == pytest.approx(taken / 0.05, abs=3)
