"""Plan exploration candidates on the learnt car, predict their closed-loop errors, and choose the next one."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from driftjax.control.dither import corner_excitation
from driftjax.control.lqr import feedback_gains, linearise_along, state_units
from driftjax.control.mpc import DriftOCP, along, within_limits
from driftjax.control.mpc_solution import solve_mpc
from driftjax.control.table import ReferenceTable
from driftjax.core import as_float
from driftjax.explore.acquisition import Assessment, Prediction, assess_candidates, least_error, sampled_errors
from driftjax.learning.arrival import Arrival
from driftjax.learning.reference import Aim, aimed_reference, put_onto
from driftjax.learning.scenario import ACQUISITION, Scenario, entry_problems, problems
from driftjax.parallel import vmap_batch
from driftjax.solve import Options
from driftjax.vehicle import Residual

NODES = 24  # at which the unknown rate errors of a plan act and its lateral error is assessed
ON_ROAD = 0.95  # least probability of staying within the limits at every node
DRAWS = 64  # sampled laps of the expected improvement
BARRIER, STEPS = 0.1, 60  # of the solve that is differentiated, which starts from its solution


class Grid(NamedTuple):
    """Candidates, the same for all entries: every change of speed with every sideslip, without and with excitation."""

    V: Float[Array, " C"]  # added to the planned speed [m/s]
    beta: Float[Array, " C"]  # factor on the planned sideslip [-]
    dither: Float[Array, "C 2"]  # amplitude of the excitation of steering [rad] and drive [N]


class Acquired(eqx.Module):
    """Choice of every batch entry (leading axis), and what was predicted of its candidates."""

    index: Array  # (batch,)
    V: Array  # (batch,) speed added to the planned one [m/s]
    beta: Array  # (batch,) factor on the planned sideslip [-]
    dither: Array  # (batch, 2)
    possible: Array  # (batch,) whether any candidate was drivable
    drivable: Bool[Array, "batch C"]
    assessment: Assessment  # fields (batch, C)


def candidate_grid(scenario: Scenario) -> Grid:
    """Build the candidates of the corner of `scenario`."""
    config, V_b = scenario.config.explore, scenario.corner.V_b
    V = V_b * np.linspace(*config.speed_range, config.num_speeds)
    amplitude = np.asarray(scenario.amplitude(*config.dither))
    each = [(v, b, d) for d in ((0.0, 1.0) if amplitude.any() else (0.0,)) for v in V for b in config.sideslips]
    return Grid(*(jnp.array(column) for column in zip(*((v, b, d * amplitude) for v, b, d in each), strict=True)))


def plan_candidates(
    ocp: DriftOCP, arrival: Arrival, table: ReferenceTable, plan: ReferenceTable, aims: Aim, lead: Array, tol: Array
) -> tuple[ReferenceTable, Bool[Array, " C"]]:
    """Plan the corner of one car for all `aims` (C), to first order about the `plan` along the path of the first aim.

    One optimal control problem is solved, at the planned speed and sideslip, and its solution is differentiated by
    those of the aim: two more solves of its linear system, however many the candidates. Inputs are put into their
    limits. Also returned is which candidates have a plan: none where the solve failed.
    """
    s = table.schedule(table.drift_start - lead, ocp.horizon, ocp.dt)
    X, U = plan.reference(s).states(), plan.inputs(s[:-1])
    unchanged = jax.tree.map(lambda a: a[0], aims)

    def solution(change: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        aim = eqx.tree_at(lambda a: (a.V, a.beta), unchanged, (change[0], 1 + change[1]))
        target, options = aimed_reference(table, aim, s), Options(tol, BARRIER, STEPS)
        done = solve_mpc(ocp, arrival.x, arrival.command, arrival.lagged_input, target, X, U, options)
        trajectory = done.X, done.plan.U * ocp.u_scale
        return trajectory, trajectory

    slopes, solved = jax.jacfwd(solution, has_aux=True)(jnp.zeros(2))
    changes = jnp.stack([aims.V, aims.beta - 1], axis=1)
    X, U = (at + jnp.einsum("tia,ca->cti", slope, changes) for at, slope in zip(solved, slopes, strict=True))
    U = jax.vmap(lambda U: within_limits(ocp, U, arrival.command, share=0.0))(U)
    tables = jax.vmap(lambda X, U: put_onto(table, s, X, U))(X, U)
    return tables, jnp.all(jnp.isfinite(X), axis=(1, 2))


def predict_errors(ocp: DriftOCP, table: ReferenceTable, aim: Aim, lead: Array, num: int, dither: Array) -> Prediction:
    """Predict the errors of one candidate, with the drift MPC along its plan as a linear feedback without limits.

    An unknown rate error is constant between nodes and acts like the known one, on V, beta and r, over each step.
    Lateral error counts from the path aimed at: the offset aimed at stands for errors of past laps that no model
    explains.
    """
    model, units = linearise_along(ocp, table, num, lead), state_units(ocp)
    K, every = feedback_gains(model), -(-num // NODES)
    section = table.drift_end - table.drift_start
    excite = dither / ocp.u_scale * corner_excitation((model.s - table.drift_start + lead) / (section + lead))
    enter = jnp.zeros((9, 3)).at[jnp.arange(3), jnp.arange(3)].set(ocp.dt / units[:3])

    def on(carry, row):
        S, x = carry  # by the rate errors of all nodes so far, and by the excitation
        A, B, K, u, node = row
        closed = A - B @ K
        S_after = jnp.einsum("ab,bnj->anj", closed, S).at[:, node].add(enter)
        return (S_after, closed @ x + B @ u), (S[3] * units[3], x * units)

    node = jnp.arange(num) // every
    start = jnp.zeros((9, NODES, 3)), jnp.zeros(9)
    G, x = jax.lax.scan(on, start, (model.A, model.B, K, excite, node))[1]
    s, U = model.s, model.u * ocp.u_scale
    plan = table.reference(s)
    acting = along(ocp, U[0], U)[1:] + x[:, 7:]
    z = jnp.concatenate([plan.states()[:, :3] + x[:, :3], acting], axis=1)
    e = plan.e - jnp.interp(s, aim.s, aim.e, left=0.0, right=0.0) + x[:, 3]
    inside = (s >= table.drift_start) & (s <= table.drift_end)
    ds = jnp.where(inside, plan.V, 0.0)
    middle = jnp.minimum(jnp.arange(NODES) * every + every // 2, num - 1)
    weight = jax.ops.segment_sum(ds, node, NODES) / jnp.sum(ds)
    return Prediction(z[middle], e[middle], G[middle], weight, as_float(every), jnp.asarray(True))


def acquire_batch(
    batch: tuple[DriftOCP, DriftOCP, Arrival, ReferenceTable, Array, Array, Array],
    table: ReferenceTable, grid: Grid, s: Array, lead: Array, tolerance: Array, limit: Array, laps_left: Array,
    rule: str,
) -> Acquired:  # fmt: skip
    """Choose a candidate for batch entries (entry problem, MPC, arrival, plan, offset aimed at, best error, key).

    `rule` is one of `ExploreConfig.acquisition` but the paper's.
    """
    C = len(grid.V)

    def one(
        entry: DriftOCP, mpc: DriftOCP, arrival: Arrival, plan: ReferenceTable, offset: Array, error: Array, key: Array
    ) -> Acquired:
        aims = Aim(grid.V, grid.beta, jnp.broadcast_to(s, (C, *s.shape)), jnp.broadcast_to(offset, (C, *offset.shape)))
        tables, planned = plan_candidates(entry, arrival, table, plan, aims, lead, tolerance)
        # the model is the same for all candidates, and one after the other needs less memory than a batch
        one_by_one = lambda of: predict_errors(mpc, of[0], of[1], lead, entry.horizon, of[2])
        each = jax.lax.map(one_by_one, (tables, aims, grid.dither))
        p = eqx.tree_at(lambda p: (p.drivable, p.rows), each, (planned, each.rows[0]))
        gp, (assessing, drawing) = mpc.residual.gp, jax.random.split(key)
        assessed = assess_candidates(p, gp, limit, assessing)
        drivable = planned & (assessed.on_road >= ON_ROAD)
        if rule == "knowledge_gradient":
            score = assessed.error - laps_left * assessed.gain
        elif rule == "random":
            score = jax.random.uniform(drawing, (C,))
        else:
            laps = sampled_errors(p, gp, drawing, DRAWS if rule == "expected_improvement" else 1)
            score = laps[0] if rule == "thompson" else -jnp.mean(jnp.maximum(error - laps, 0.0), axis=0)
        index = least_error(score, drivable)
        chosen = (grid.V[index], grid.beta[index], grid.dither[index])
        return Acquired(index, *chosen, jnp.any(drivable), drivable, assessed)

    return vmap_batch(one)(*batch)


def acquire(
    scenario: Scenario, residual: Residual, arrival: Arrival, plan: ReferenceTable, offset: Array, error: Array,
    laps_left: int, number: int,
) -> Acquired:  # fmt: skip
    """Choose what every entry drives next in stage `number`.

    `plan` is its reference at the planned speed and sideslip, along the `offset` (batch, AIM_POINTS) from the path;
    `error` [m] is that of its best lap.
    """
    config, grid = scenario.config, candidate_grid(scenario)
    keys = jax.vmap(lambda key: jax.random.fold_in(key, ACQUISITION + number))(scenario.keys)
    table = scenario.table
    s = jnp.linspace(table.drift_start, table.drift_end, offset.shape[1])
    batch = entry_problems(scenario, residual), problems(scenario, residual), arrival, plan, offset, error, keys
    numbers = (as_float(value) for value in (config.switch.lead, config.mpc.tolerance, scenario.margin, laps_left))
    return scenario.executor.map(acquire_batch, batch, table, grid, s, *numbers, config.explore.acquisition)
