"""Build references along the planned path: the plan, the paper's step, the corner replanned on the corrected car."""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.control.mpc import DriftOCP, Reference
from driftjax.control.mpc_solution import solve_mpc
from driftjax.control.table import ReferenceTable
from driftjax.core import Control, State
from driftjax.learning.arrival import Arrival
from driftjax.planner import Plan
from driftjax.sim import where_tree
from driftjax.solve import Options

POINTS = 400  # rows of a reference table
AIM_POINTS = 40  # of a curve over the drift section
ENTRY_ERROR = 1e-2  # scaled optimality error up to which a planned corner serves as reference
ENTRY_SHARES = (1.0, 0.25, 0.5, 0.75, 1.0)  # fraction of the learnt residual: all at once, then gradually
CORE = 0.5  # central fraction of the drift section taken as the steady part of the corner


def plan_table(plan: Plan) -> ReferenceTable:
    """Return the minimum-time plan as reference: dynamically consistent with the nominal car, entry and exit included.

    The path's tangent is the planned course, so the planned heading error is -beta and the planned offset 0.
    """
    start, end = plan.drift_interval()
    s = np.linspace(0.0, float(plan.path.length), POINTS)
    at = lambda values: jnp.asarray(np.interp(s, np.asarray(plan.S), np.asarray(values)))
    beta = at(plan.beta)
    kappa = eqx.filter_jit(plan.path.pose)(s)[3]
    return ReferenceTable(
        0.0, s[1], speed=at(plan.V), kappa=kappa, V=at(plan.V), beta=beta, r=at(plan.r), e=jnp.zeros(POINTS),
        theta=-beta, delta=at(plan.delta), Fxr=at(plan.Fxr), drift_start=start, drift_end=end,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Corner:
    """Baseline of the steady part of the planned corner."""

    V_b: float  # planned speed [m/s]
    r_b: float  # planned yaw rate [rad/s]
    R: float  # radius of the path, positive to the left [m]
    beta: float  # sideslip aimed at, opposite in sign to the turn [rad]


def steady_corner(table: ReferenceTable, drift_beta: float) -> Corner:
    """Return the steady part of the corner in `table`, at sideslip magnitude `drift_beta`."""
    s = np.asarray(table.start + table.spacing * np.arange(POINTS))
    middle, half = (table.drift_start + table.drift_end) / 2, CORE * (table.drift_end - table.drift_start) / 2
    inside = np.abs(s - float(middle)) <= float(half)
    V_b, kappa = float(np.mean(np.asarray(table.V)[inside])), float(np.mean(np.asarray(table.kappa)[inside]))
    return Corner(V_b, V_b * kappa, 1 / kappa, -math.copysign(drift_beta, kappa))


class Aim(eqx.Module):
    """Exploration targets: changes of the planned reference."""

    V: Array  # added to the speed aimed at [m/s]
    beta: Array  # factor on the sideslip aimed at [-]
    s: Float[Array, " K"]  # arc lengths from the first to the last of the drift section [m]
    e: Float[Array, " K"]  # offset from the path to aim at there [m]


def no_aim(table: ReferenceTable) -> Aim:
    """Return the targets that change nothing: planned speed, sideslip and path."""
    s = jnp.linspace(table.drift_start, table.drift_end, AIM_POINTS)
    return Aim(jnp.zeros(()), jnp.ones(()), s, jnp.zeros(AIM_POINTS))


class Planned(eqx.Module):
    """Reference planned on a corrected car with its convergence; where that failed, `table` is the fallback."""

    table: ReferenceTable
    converged: Array  # bool
    error: Array  # scaled optimality error and violation, or the residual of the equilibrium [-]
    num_steps: Array


class Attempt(NamedTuple):
    """State of the homotopy for a planned entry."""

    X: Float[Array, "N+1 5"]
    U: Float[Array, "N 2"]
    error: Array  # as in `Planned`
    share: Array  # fraction of the learnt residual in `X`, `U`
    num_steps: Array


def step_table(table: ReferenceTable, x: State, u: Control) -> ReferenceTable:
    """Return the paper's reference: the constant drift state (V_ep, beta_eq, r_b) over the drift controller's range."""
    level = lambda value: jnp.broadcast_to(value, table.V.shape)
    new = (level(x.V), level(x.beta), level(x.r), jnp.zeros_like(table.e), level(-x.beta), level(u.delta), level(u.Fxr))
    return eqx.tree_at(lambda t: (t.V, t.beta, t.r, t.e, t.theta, t.delta, t.Fxr), table, new)


def entry_horizon(table: ReferenceTable, lead: float, trail: float, dt: float) -> int:
    """Return the number of steps of `dt` [s] from `lead` before the drift section to `trail` after it [m]."""
    s = np.asarray(table.start + table.spacing * np.arange(POINTS))
    inside = (s >= float(table.drift_start) - lead) & (s <= float(table.drift_end) + trail)
    return math.ceil(float(np.sum(float(table.spacing) / np.asarray(table.V)[inside])) / dt)


def aimed_reference(table: ReferenceTable, aim: Aim, s: Float[Array, " N+1"]) -> Reference:
    """Return the reference to track: plan plus changes `aim`, at the arc lengths `s` [m]."""
    plan = table.reference(s)
    e = plan.e + jnp.interp(s, aim.s, aim.e, left=0.0, right=0.0)
    turned = (aim.beta - 1) * plan.beta  # the course stays
    return Reference(plan.V + aim.V, plan.beta + turned, plan.r, e, plan.theta - turned, plan.kappa)


def entry_table(
    ocp: DriftOCP, table: ReferenceTable, arrival: Arrival, lead: Array, aim: Aim, options: Options
) -> Planned:
    """Plan the corner that the model in `ocp` can drive: one optimal control problem from the straight.

    Starts `lead` metres before the drift section in the state `arrival` and tracks path and sideslip of the plan in
    `table`; speed, yaw rate and inputs follow from the model. `aim` changes target speed, sideslip and path. Where the
    solve fails, a homotopy leads from the nominal car to the corrected one in `ENTRY_SHARES`. Rows outside the horizon
    keep the plan, as does the whole table where the homotopy fails too.
    """
    s0 = table.drift_start - lead
    s = table.schedule(s0, ocp.horizon, ocp.dt)
    target = aimed_reference(table, aim, s)
    X, U = table.reference(s).states(), table.inputs(s[:-1])

    def attempt(last: Attempt, share: Array) -> tuple[Attempt, None]:
        steps = jnp.where(last.error < ENTRY_ERROR, 0, options.max_steps)
        restart = share < last.share  # the whole model at once has failed
        X_guess, U_guess = jnp.where(restart, X, last.X), jnp.where(restart, U, last.U)
        part = eqx.tree_at(lambda o: o.residual, ocp, ocp.residual.scaled(share))
        allowed = Options(options.tolerance, options.barrier, steps)
        solution = solve_mpc(part, arrival.x, arrival.command, arrival.lagged_input, target, X_guess, U_guess, allowed)
        kkt = jnp.maximum(solution.plan.kkt, solution.plan.violation)
        error = jnp.where(share < 1, jnp.inf, kkt)  # a partial model gives a guess, never a solution
        new = Attempt(solution.X, solution.U, error, share, last.num_steps + solution.plan.num_steps)
        return where_tree(steps > 0, new, last), None

    first = Attempt(X, U, jnp.asarray(jnp.inf), jnp.asarray(0.0), jnp.asarray(0))
    best, _ = jax.lax.scan(attempt, first, jnp.asarray(ENTRY_SHARES))
    good = best.error < ENTRY_ERROR
    new = put_onto(table, s, best.X, best.U)
    new = jax.tree.map(lambda a, b: jnp.where(good, a, b), new, table)
    return Planned(new, good, best.error, best.num_steps)


def put_onto(table: ReferenceTable, s: Array, X: Float[Array, "N+1 5"], U: Float[Array, "N 2"]) -> ReferenceTable:
    """Replace the rows of `table` between the ends of `s` by the trajectory."""
    grid = table.start + table.spacing * jnp.arange(table.V.shape[0])
    inside = (grid >= s[0]) & (grid <= s[-1])
    put = lambda old, values, at: jnp.where(inside, jnp.interp(grid, at, values), old)
    V, beta, r, e, theta = (put(old, X[:, i], s) for i, old in
                            enumerate((table.V, table.beta, table.r, table.e, table.theta)))  # fmt: skip
    delta, Fxr = put(table.delta, U[:, 0], s[:-1]), put(table.Fxr, U[:, 1], s[:-1])
    return eqx.tree_at(
        lambda t: (t.V, t.beta, t.r, t.e, t.theta, t.delta, t.Fxr), table, (V, beta, r, e, theta, delta, Fxr)
    )
