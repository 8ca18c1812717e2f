"""Candidates of the exploration: first-order plans against solved ones, predicted errors against closed-loop ones."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.control.drift_batch_ocp import to_batch_ocp
from driftjax.control.lqr import feedback_gains, linearise_along, state_units
from driftjax.learning.acquire import NODES, acquire, candidate_grid, plan_candidates, predict_errors
from driftjax.learning.config import load_learn_config
from driftjax.learning.model import empty
from driftjax.learning.reference import AIM_POINTS, Aim, no_aim, put_onto
from driftjax.learning.scenario import build_scenario, entry_problems, problems
from driftjax.learning.stages import first_progress
from driftjax.learning.updates import entry_table_batch, plan_reference
from driftjax.parallel import BatchExecutor

RC = load_learn_config("rc").nothing_learnt  # the car without free parameters compiles sooner


@pytest.fixture(scope="module")
def scenario():
    explore = dataclasses.replace(RC.explore, acquisition="knowledge_gradient")
    return build_scenario(dataclasses.replace(RC, plants=1, explore=explore), BatchExecutor(1))


@pytest.fixture(scope="module")
def corner_plan(scenario):
    """Entry problem, MPC, arrival, plan and its aim, of the nominal car."""
    residual = scenario.over_batch(empty(RC.gp).residual)
    progress, first = first_progress(scenario), lambda tree: jax.tree.map(lambda a: a[0], tree)
    plan = plan_reference(scenario, residual, progress.arrival)
    assert bool(plan.converged[0])
    problem, mpc = entry_problems(scenario, residual), problems(scenario, residual)
    return *map(first, (problem, mpc, progress.arrival, plan.table)), no_aim(scenario.table)


def drift_rows(scenario, table):
    """Sideslip, yaw rate, speed and offset of a plan at places in the corner."""
    s = jnp.linspace(table.drift_start, table.drift_end, 30)
    return np.array([[table.row(column, at) for at in s] for column in (table.V, table.beta, table.r, table.e)])


@pytest.mark.slow
def test_plans_to_first_order_are_the_tangent_of_solved_ones(scenario, corner_plan):
    entry, _, arrival, plan, still = corner_plan
    lead, tolerance = jnp.asarray(RC.switch.lead), jnp.asarray(1e-7)
    small = 0.02 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    V_b, point = scenario.corner.V_b, jnp.zeros((len(small), AIM_POINTS))
    V, beta = jnp.asarray(V_b * small[:, 0]), jnp.asarray(1 + small[:, 1])
    aims = Aim(V, beta, point + still.s, point)
    tables, planned = eqx.filter_jit(plan_candidates)(entry, arrival, scenario.table, plan, aims, lead, tolerance)
    assert np.all(planned)
    wide = lambda tree: jax.tree.map(lambda a: jnp.broadcast_to(a, (len(small), *a.shape)), tree)
    batch = (wide(entry), wide(arrival), aims)
    solved = scenario.executor.map(entry_table_batch, batch, scenario.table, lead, jnp.asarray(1e-6))
    assert np.all(solved.converged)
    rows = lambda tables: np.stack([drift_rows(scenario, jax.tree.map(lambda a, k=k: a[k], tables)) for k in range(4)])
    first, full = rows(tables), rows(solved.table)
    for plus, minus in ((0, 1), (2, 3)):
        ours, theirs = first[plus] - first[minus], full[plus] - full[minus]
        assert np.linalg.norm(theirs) > 1e-3
        assert np.linalg.norm(ours - theirs) < 0.3 * np.linalg.norm(theirs)


def test_predicted_errors_are_those_of_the_car_under_the_feedback(scenario, corner_plan):
    """Drive the nonlinear car with the linear feedback and a small rate error between two nodes.

    The reference is a lap of this car: about the plan, which it leaves by centimetres, the slopes are others.
    """
    entry, mpc, _, plan, still = corner_plan
    lead, num = jnp.asarray(RC.switch.lead), entry.horizon
    every, none = -(-num // NODES), jnp.zeros(2)
    units, one = state_units(mpc), jax.tree.map(lambda a: a[None], mpc)
    problem = to_batch_ocp(one, one.u_scale[:, 1])

    def step(x, u, reference):
        """Return motion, last command and actuator outputs (9,) one step later."""
        at = [x[i : i + 1] for i in (0, 1, 2, 3, 4, 7, 8)]
        y = jnp.concatenate(problem.step(at, [u[:1], u[1:]], jax.tree.map(lambda a: a[None], reference)))
        return jnp.concatenate([y[:5], u, y[5:]])

    @eqx.filter_jit
    def lap(table, d):
        """Arc lengths, states (num, 9) and inputs of a lap along `table` with the rate errors `d` (num, 3); SI."""
        model = linearise_along(mpc, table, num, lead)
        K, reference = feedback_gains(model), table.reference(model.s)
        x_ref = jnp.concatenate([reference.states(), model.u * mpc.u_scale, model.u * mpc.u_scale], axis=1) / units

        def on(x, row):
            x_ref, u_ref, K, reference, d = row
            u = u_ref - K @ (x - x_ref)
            after = step(x, u, reference)
            return after.at[:3].add(mpc.dt * d / units[:3]), (x * units, u * mpc.u_scale)

        return model.s, *jax.lax.scan(on, x_ref[0], (x_ref, model.u, K, reference, d))[1]

    table, quiet = plan, jnp.zeros((num, 3))
    for _ in range(4):
        s, X, U = lap(table, quiet)
        table = put_onto(table, s, X[:, :5], U[:-1])
    p = eqx.filter_jit(predict_errors)(mpc, table, still, lead, num, none)
    middle = np.minimum(np.arange(NODES) * every + every // 2, num - 1)
    s, X, _ = lap(table, quiet)
    e = np.asarray(X[:, 3])
    for node, output, size in ((NODES // 2, 0, 0.05), (NODES // 2, 1, 0.02), (NODES // 3, 2, 0.2)):
        d = np.zeros((num, 3))
        d[node * every : (node + 1) * every, output] = size
        moved = (np.asarray(lap(table, jnp.asarray(d))[1][:, 3]) - e)[middle] / size
        assert np.max(np.abs(moved)) > 1e-4
        np.testing.assert_allclose(p.G[:, node, output], moved, atol=0.2 * np.max(np.abs(moved)))
    assert float(jnp.sum(p.weight)) == pytest.approx(1.0)
    np.testing.assert_allclose(p.mean, np.asarray(table.reference(s).e)[middle], rtol=0.1, atol=1e-4)


@pytest.mark.slow
def test_a_choice_is_made_for_every_entry_and_is_one_of_the_grid(scenario, corner_plan):
    residual = scenario.over_batch(empty(RC.gp).residual)
    arrival, offset = first_progress(scenario).arrival, jnp.zeros((1, AIM_POINTS))
    plan = jax.tree.map(lambda a: a[None], corner_plan[3])
    chosen = acquire(scenario, residual, arrival, plan, offset, jnp.array([0.05]), 2, 7)
    grid = candidate_grid(scenario)
    k = int(chosen.index[0])
    assert float(chosen.V[0]) == float(grid.V[k]) and float(chosen.beta[0]) == float(grid.beta[k])
    np.testing.assert_array_equal(chosen.dither[0], grid.dither[k])
    assert len(grid.V) >= 30 and chosen.assessment.error.shape == (1, len(grid.V))
    assert np.all(np.isfinite(chosen.assessment.error)) and np.all(chosen.assessment.deviation > 0)
