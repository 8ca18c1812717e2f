"""Sequential quadratic programming for one problem: each program is one interior-point Newton system, with line search.

Every iteration linearises the dynamics anew, takes the Hessian of the Lagrangian, solves the primal-dual barrier
system by one Riccati sweep and searches along the policy that comes out of it: trial points are roll-outs of the
nonlinear dynamics under the feedback, with the defects of the guess closed in proportion to the step. So unstable
dynamics stay tame, and the l1 merit function sees no second-order defects that would shorten good steps.
Sources: Waechter and Biegler 2006 (barrier, fraction to the boundary, error scaling); Mastalli et al. 2020 (roll-out
with gaps); Nocedal and Wright 2006, Sec. 18.3 and 19.3 (merit function, slacks).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

from driftjax.core import RESULTS
from driftjax.solve.ocp import AbstractOCP, Options, Solution
from driftjax.solve.riccati import Direction, Quadratic, newton_direction
from driftjax.solve.solution_derivative import split

BOUNDARY_FRACTION = 0.995  # of the way to a bound that one step may take
MAX_BACKTRACKS = 8  # halvings before a direction is given up
MAX_FAILURES = 10  # directions without descent in a row before the solve counts as stalled
ARMIJO = 1e-4
CENTRALITY = 100.0  # factor by which a product of slack and dual may differ from the barrier parameter
SLACK_FLOOR = 1e-4  # slack given to a gap that starts closed or violated
# What a failed search changes, level by level: share of the dynamics' curvature kept, damping of the Hessian.
# Without that curvature a convex cost gives a descent direction (Gauss-Newton); damping then shortens it.
CURVATURE = (1.0, 1.0, 1.0, 1.0, 0.0, 0.0)
DAMPING = (0.0, 1e-2, 1e-1, 1.0, 1e-1, 1.0)


class Iterate(NamedTuple):
    """Primal and dual variables; gaps of the stages (N, ng) and of the last state (nt,)."""

    X: Array
    U: Array
    costates: Array  # (N, nx), of the dynamics into x_1..x_N
    slack: tuple[Array, Array]
    dual: tuple[Array, Array]


class IterateDerivatives(NamedTuple):
    """Derivatives of a problem at one iterate."""

    cost_x: Array
    cost_u: Array
    A: Array
    B: Array
    expansion: PyTree
    defect: Array
    gap: tuple[Array, Array]
    grad_N: Array


class IterationState(NamedTuple):
    it: Iterate
    barrier: Array
    caution: Array  # level in CURVATURE and DAMPING
    failures: Array
    num_steps: Array
    kkt: Array
    violation: Array
    length: Array  # of the last step; 0 where none was taken
    open: Array  # whether to go on


class OCPInstance(eqx.Module):
    """One problem with its data; its methods depend on the iterate only."""

    ocp: AbstractOCP
    stages: PyTree
    last: PyTree
    Gx: Array  # Jacobian of the gaps, constant because they are affine
    Gu: Array
    GN: Array

    def objective(self, X: Array, U: Array) -> Array:
        return jnp.sum(jax.vmap(self.ocp.cost)(X[:-1], U, self.stages)) + self.ocp.terminal(X[-1], self.last)

    def gaps(self, X: Array, U: Array) -> tuple[Array, Array]:
        stage = jax.vmap(self.ocp.constraints)(X[:-1], U, self.stages)
        return stage, self.ocp.terminal_constraints(X[-1], self.last)

    def defects(self, X: Array, U: Array) -> Array:
        return jax.vmap(self.ocp.step)(X[:-1], U, self.stages) - X[1:]

    def linearise(self, X: Array, U: Array) -> IterateDerivatives:
        cost_x, cost_u = jax.vmap(jax.grad(self.ocp.cost, (0, 1)))(X[:-1], U, self.stages)
        expansion = self.ocp.local_expansion(X[:-1], U, self.stages)
        y, A, B = jax.vmap(self.ocp.linearise)(X[:-1], U, self.stages, expansion)
        grad_N = jax.grad(self.ocp.terminal)(X[-1], self.last)
        return IterateDerivatives(cost_x, cost_u, A, B, expansion, y - X[1:], self.gaps(X, U), grad_N)

    def hessian(self, it: Iterate, expansion: PyTree, curvature: Array) -> tuple[Array, Array, Array, Array]:
        """Return the blocks xx, ux, uu of the stages' Lagrangian, and the Hessian of the last state."""

        nx = it.X.shape[1]

        def stage(x, u, costate, p, expansion):
            H = jax.hessian(lambda w: self.ocp.cost(w[:nx], w[nx:], p))(jnp.concatenate([x, u]))
            return H + curvature * self.ocp.curvature(x, u, costate, p, expansion)

        H = jax.vmap(stage)(it.X[:-1], it.U, it.costates, self.stages, expansion)
        return (
            H[:, :nx, :nx],
            H[:, nx:, :nx],
            H[:, nx:, nx:],
            jax.hessian(self.ocp.terminal)(it.X[-1], self.last),
        )


def problem_of(ocp: AbstractOCP, params: PyTree, X: Array, U: Array) -> OCPInstance:
    """Return `ocp` with the data `params` (N+1 rows); its affine gaps have the same Jacobian at any `X`, `U`."""
    stages, last = split(params)
    Gx, Gu = jax.vmap(jax.jacfwd(ocp.constraints, (0, 1)))(X[:-1], U, stages)
    return OCPInstance(ocp, stages, last, Gx, Gu, jax.jacfwd(ocp.terminal_constraints)(X[-1], last))


def quadratic(problem: OCPInstance, m: IterateDerivatives, it: Iterate, barrier: Array, caution: Array) -> Quadratic:
    """Return the Newton system with slacks and duals eliminated."""
    damping = jnp.asarray(DAMPING)[caution]
    Hxx, Hux, Huu, HN = problem.hessian(it, m.expansion, jnp.asarray(CURVATURE)[caution])
    weight = jax.tree.map(lambda z, s: z / s, it.dual, it.slack)
    pull = jax.tree.map(lambda w, g, s: w * (g - s) - barrier / s, weight, m.gap, it.slack)

    def damped(H):
        diagonal = jnp.abs(jnp.diagonal(H, axis1=-2, axis2=-1)) + 1e-3
        return H + damping * diagonal[..., None] * jnp.eye(H.shape[-1])

    w, Gx, Gu, GN = weight[0], problem.Gx, problem.Gu, problem.GN
    return Quadratic(
        Hxx=damped(Hxx) + jnp.einsum("kgi,kg,kgj->kij", Gx, w, Gx),
        Hux=Hux + jnp.einsum("kgi,kg,kgj->kij", Gu, w, Gx),
        Huu=damped(Huu) + jnp.einsum("kgi,kg,kgj->kij", Gu, w, Gu),
        hx=m.cost_x + jnp.einsum("kgi,kg->ki", Gx, pull[0]),
        hu=m.cost_u + jnp.einsum("kgi,kg->ki", Gu, pull[0]),
        A=m.A,
        B=m.B,
        c=m.defect,
        HN=damped(HN) + (GN.T * weight[1]) @ GN,
        hN=m.grad_N + GN.T @ pull[1],
    )


def _direction(
    problem: OCPInstance, m: IterateDerivatives, it: Iterate, q: Quadratic, barrier: Array
) -> tuple[Iterate, Direction]:
    newton = newton_direction(q)
    d_gap = (
        jnp.einsum("kgi,ki->kg", problem.Gx, newton.dX[:-1]) + jnp.einsum("kgi,ki->kg", problem.Gu, newton.dU),
        problem.GN @ newton.dX[-1],
    )
    d_slack = jax.tree.map(lambda d, g, s: d + g - s, d_gap, m.gap, it.slack)
    d_dual = jax.tree.map(lambda s, z, ds: barrier / s - z - z / s * ds, it.slack, it.dual, d_slack)
    return Iterate(newton.dX, newton.dU, newton.costates - it.costates, d_slack, d_dual), newton


def _to_boundary(values: PyTree, steps: PyTree) -> Array:
    """Return the longest step in (0, 1] that keeps every value positive by the boundary fraction."""
    rates = jax.tree.map(lambda v, d: jnp.max(-d / v, initial=0.0), values, steps)
    return jnp.minimum(1.0, BOUNDARY_FRACTION / jnp.maximum(jnp.max(jnp.stack(jax.tree.leaves(rates))), 1e-12))


def _kkt(problem: OCPInstance, m: IterateDerivatives, it: Iterate) -> tuple[Array, Array]:
    """Return the scaled optimality error (Waechter and Biegler 2006, Eq. 5) and the largest primal violation."""
    in_costates = jnp.concatenate([jnp.zeros_like(it.costates[:1]), it.costates[:-1]])
    stage_x = m.cost_x + jnp.einsum("kij,ki->kj", m.A, it.costates) - in_costates
    stage_x = stage_x - jnp.einsum("kgi,kg->ki", problem.Gx, it.dual[0])
    stage_u = m.cost_u + jnp.einsum("kij,ki->kj", m.B, it.costates)
    stage_u = stage_u - jnp.einsum("kgi,kg->ki", problem.Gu, it.dual[0])
    last = m.grad_N - it.costates[-1] - problem.GN.T @ it.dual[1]
    size = sum(jnp.sum(jnp.abs(y)) for y in (it.costates, *it.dual))
    scale = jnp.maximum(1.0, size / (it.costates.size + sum(z.size for z in it.dual)) / 100)
    products = [jnp.max(jnp.abs(s * z), initial=0.0) for s, z in zip(it.slack, it.dual, strict=True)]
    parts = [jnp.max(jnp.abs(stage_x[1:]), initial=0.0), jnp.max(jnp.abs(stage_u)), jnp.max(jnp.abs(last))]
    misfit = [jnp.max(jnp.abs(g - s), initial=0.0) for g, s in zip(m.gap, it.slack, strict=True)]
    violation = jnp.maximum(jnp.max(jnp.abs(m.defect)), jnp.max(jnp.stack(misfit)))
    return jnp.max(jnp.stack(parts + products)) / scale, violation


class TrialPoint(NamedTuple):
    """Trial point of the line search."""

    X: Array
    U: Array
    slack: tuple[Array, Array]
    merit: Array


def _roll(
    problem: OCPInstance, m: IterateDerivatives, it: Iterate, newton: Direction, length: Array
) -> tuple[Array, Array]:
    """Roll out the dynamics under the policy at step `length`; defects shrink by exactly 1 - length."""

    def move(x, stage):
        X, U, K, k, defect, p = stage
        u = U + length * k + K @ (x - X)
        x_next = problem.ocp.step(x, u, p) - (1 - length) * defect
        return x_next, (x_next, u)

    stages = (it.X[:-1], it.U, newton.K, newton.k, m.defect, problem.stages)
    _, (X, U) = jax.lax.scan(move, it.X[0], stages)
    return jnp.concatenate([it.X[:1], X]), U


def _try(
    problem: OCPInstance, m: IterateDerivatives, it: Iterate, step: Iterate, newton: Direction, weights, length: Array
) -> TrialPoint:
    barrier, penalty = weights
    X, U = _roll(problem, m, it, newton, length)
    gap = problem.gaps(X, U)
    # a gap that is open by itself is its own slack; only one that is closed keeps the slack of the linear step
    slack = jax.tree.map(
        lambda g, s, d: jnp.where(g > (1 - BOUNDARY_FRACTION) * s, g, s + length * d), gap, it.slack, step.slack
    )
    bad = (1 - length) * jnp.sum(jnp.abs(m.defect))
    bad = bad + sum(jnp.sum(jnp.abs(g - s)) for g, s in zip(gap, slack, strict=True))
    logs = sum(jnp.sum(jnp.log(s)) for s in slack)
    return TrialPoint(X, U, slack, problem.objective(X, U) - barrier * logs + penalty * bad)


def _line_search(
    problem: OCPInstance, m: IterateDerivatives, it: Iterate, step: Iterate, newton: Direction, barrier, longest
):
    """Return step length and point by backtracking on the l1 merit function; length 0 without descent."""
    # 1.1 x the largest multiplier makes the l1 penalty exact, so that the Newton step is a descent direction
    worst = [jnp.max(jnp.abs(it.costates + step.costates))]
    worst += [jnp.max(jnp.abs(z + d), initial=0.0) for z, d in zip(it.dual, step.dual, strict=True)]
    penalty = 1.1 * jnp.max(jnp.stack(worst))
    misfit = sum(jnp.sum(jnp.abs(g - s)) for g, s in zip(m.gap, it.slack, strict=True))
    bad = jnp.sum(jnp.abs(m.defect)) + misfit
    along = jnp.sum(m.cost_x * step.X[:-1]) + jnp.sum(m.cost_u * step.U) + m.grad_N @ step.X[-1]
    along = along - barrier * sum(jnp.sum(d / s) for s, d in zip(it.slack, step.slack, strict=True)) - penalty * bad
    logs = sum(jnp.sum(jnp.log(s)) for s in it.slack)
    start = problem.objective(it.X, it.U) - barrier * logs + penalty * bad
    rounding = 1e-10 * (1 + jnp.abs(start))
    attempt = lambda length: _try(problem, m, it, step, newton, (barrier, penalty), length)

    def fails(carry):
        length, count, trial = carry
        enough = trial.merit <= start + ARMIJO * length * jnp.minimum(along, 0.0) + rounding
        return ~(enough & jnp.isfinite(trial.merit)) & (count < MAX_BACKTRACKS)

    def shorten(carry):
        length, count, _ = carry
        return length / 2, count + 1, attempt(length / 2)

    hopeless = along > rounding  # not a descent direction: no step along it is worth trying
    untried = TrialPoint(it.X, it.U, it.slack, jnp.full_like(start, jnp.inf))
    first = (2 * longest, jnp.where(hopeless, MAX_BACKTRACKS, -1), untried)
    length, count, trial = jax.lax.while_loop(fails, shorten, first)
    return jnp.where(count < MAX_BACKTRACKS, length, 0.0), trial


def _start(problem: OCPInstance, x0: Array, X: Array, U: Array, barrier: Array) -> Iterate:
    X = X.at[0].set(x0)
    slack = jax.tree.map(lambda g: jnp.maximum(g, SLACK_FLOOR), problem.gaps(X, U))
    return Iterate(X, U, jnp.zeros_like(X[1:]), slack, jax.tree.map(lambda s: barrier / s, slack))


def _next_barrier(barrier: Array, gap: Array, kkt: Array, length: Array, tolerance: Array) -> Array:
    """Barrier parameter of the next iteration: follows the complementarity `gap` down while steps are long.

    After a short step it stays until the barrier problem is nearly solved: going down with iterates pressed
    against their bounds jams them there.
    """
    follow = jnp.clip((1 - length) ** 2, 0.1, 0.8) * gap
    solved = kkt < 10 * barrier
    stay = jnp.where(solved, 0.2 * barrier, barrier)
    return jnp.maximum(jnp.where(length > 0.8, jnp.minimum(follow, barrier), stay), 0.1 * tolerance)


def _judge(problem: OCPInstance, m: IterateDerivatives, loop: IterationState, options: Options) -> IterationState:
    """Return the residuals of the iterate, the next barrier parameter, and whether to continue."""
    it, moved = loop.it, loop.length > 0
    kkt, violation = _kkt(problem, m, it)
    products = jnp.stack([jnp.sum(s * z) for s, z in zip(it.slack, it.dual, strict=True)])
    gap = jnp.sum(products) / max(sum(s.size for s in it.slack), 1)
    lower = _next_barrier(loop.barrier, gap, kkt, loop.length, options.tolerance)
    open_ = jnp.maximum(kkt, violation) > options.tolerance
    open_ &= (loop.num_steps < options.max_steps) & (loop.failures < MAX_FAILURES)
    return loop._replace(barrier=jnp.where(moved, lower, loop.barrier), kkt=kkt, violation=violation, open=open_)


def _move(problem: OCPInstance, m: IterateDerivatives, loop: IterationState) -> IterationState:
    """Return the next iterate; unchanged if no step gives descent."""
    it, barrier = loop.it, loop.barrier
    step, newton = _direction(problem, m, it, quadratic(problem, m, it, barrier, loop.caution), barrier)
    longest, dual = _to_boundary(it.slack, step.slack), _to_boundary(it.dual, step.dual)
    length, trial = _line_search(problem, m, it, step, newton, barrier, longest)
    moved = length > 0  # False also where the direction was not finite
    costates = it.costates + length * step.costates
    # roll-out and reset moved the slacks off the linear step: keep the products near the barrier
    duals = jax.tree.map(
        lambda z, d, s: jnp.clip(z + dual * d, barrier / (CENTRALITY * s), CENTRALITY * barrier / s),
        it.dual, step.dual, trial.slack,
    )  # fmt: skip
    new = Iterate(trial.X, trial.U, costates, trial.slack, duals)
    new = jax.tree.map(lambda old, candidate: jnp.where(moved, candidate, old), it, new)
    easy = length > 0.3 * longest  # at most one halving; a short way to a bound is not the model's fault
    caution = jnp.clip(loop.caution + jnp.where(easy, -1, 1), 0, len(DAMPING) - 1)
    failures = jnp.where(moved, 0, loop.failures + 1)
    length = jnp.where(moved, jnp.minimum(length, dual), 0.0)
    return loop._replace(it=new, caution=caution, failures=failures, num_steps=loop.num_steps + 1, length=length)


@eqx.filter_jit  # batching a loop passes over its body several times; a compiled body is passed over once
def _iterate(problem: OCPInstance, loop: IterationState, options: Options) -> IterationState:
    """Evaluate the iterate and step; derivatives occur here only, which keeps the program short."""
    m = problem.linearise(loop.it.X, loop.it.U)
    loop = _judge(problem, m, loop, options)
    return jax.lax.cond(loop.open, lambda: _move(problem, m, loop), lambda: loop)


def solve_interior_point(
    ocp: AbstractOCP, x0: Array, params: PyTree, X: Array, U: Array, options: Options
) -> tuple[Solution, Iterate]:
    """Return the last iterate from the guess `X`, `U`, with its multipliers; see `driftjax.solve.solve`."""
    problem = problem_of(ocp, params, X, U)
    it = _start(problem, x0, X, U, options.barrier)
    large = jnp.asarray(jnp.inf, X.dtype)
    zero = jnp.zeros((), int)
    loop = IterationState(
        it, options.barrier, zero, zero, zero, large, large, jnp.zeros((), X.dtype), options.max_steps > 0
    )
    end = jax.lax.while_loop(lambda s: s.open, lambda s: _iterate(problem, s, options), loop)
    return _plan(problem, end, options), end.it


def _plan(problem: OCPInstance, end: IterationState, options: Options) -> Solution:
    done = jnp.maximum(end.kkt, end.violation) <= options.tolerance
    failed = RESULTS.where(end.failures >= MAX_FAILURES, RESULTS.stalled, RESULTS.not_converged)
    finite = jnp.isfinite(end.kkt) & jnp.isfinite(end.violation)
    failed = RESULTS.where(finite, failed, RESULTS.non_finite)
    result = RESULTS.where(done, RESULTS.successful, failed)  # pyright: ignore[reportArgumentType]
    cost = problem.objective(end.it.X, end.it.U)
    return Solution(end.it.X, end.it.U, cost, end.kkt, end.violation, end.num_steps, result)


def shift(sequence: Float[Array, "*batch N n"]) -> Float[Array, "*batch N n"]:
    """Return the sequence shifted by one stage, last entry repeated: the warm start of the next solve."""
    return jnp.concatenate([sequence[..., 1:, :], sequence[..., -1:, :]], axis=-2)
