"""A filter line-search interior point method for long, strongly nonlinear stage-wise problems.

The drift MPC's solver takes full steps, which suits short horizons solved from a reference. A minimum-time plan starts
far from feasible over hundreds of stages; there full steps diverge from one of the sedan's two guesses and end in a
slower plan from the other, and the filter method with inertia correction converges from both (Waechter and Biegler
2006, "On the implementation of an interior-point filter line-search algorithm", Math. Program. 106; equation numbers
below refer to it). No restoration phase: where no trial step is acceptable the Hessian is shifted, which turns the step
towards feasibility.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax

from driftjax.core import RESULTS
from driftjax.solve.ocp import AbstractOCP, Options, Solution
from driftjax.solve.riccati_factors import NewtonMatrices, RiccatiFactors, factorise, solve_factored

SLACK_START = 1e-2  # least slack of a gap at the start
FILTER_SIZE = 60  # entries; the oldest give way
GAMMA = 1e-5  # margin of the filter (Eq. 18)
ARMIJO = 1e-4  # (Eq. 20)
TRIALS = 11  # points tried: the full step, a correction of it, and steps each half as long as the last
GIVE_UP = 8  # iterations in a row without an acceptable step
TOGETHER = 50  # stages differentiated at once: the derivatives of hundreds leave the processor's cache
FIRST_SHIFT, LARGEST_SHIFT = 1e-4, 1e10  # of the Hessian (Sec. 3.1)


class Point(NamedTuple):
    """Primal variables; slack of the stages' gaps (N, ng) and of the last state's (nt,)."""

    X: Array
    U: Array
    slack: tuple[Array, Array]


class FilterState(NamedTuple):
    """Iterate of the solver with its filter; scalars where no shape is given."""

    w: Point
    costates: Array  # (N, nx)
    dual: tuple[Array, Array]  # (N, ng), (nt,) of the gaps
    barrier: Array
    shift: Array  # last Hessian shift that was needed
    floor: Array  # least shift to use, raised by failed searches
    entries: Array  # (FILTER_SIZE, 2) filter: forbidden (violation, objective) corners
    failures: Array
    num_steps: Array
    kkt: Array
    violation: Array
    moved: Array  # whether the last step was acceptable
    open: Array  # whether to go on


class _Problem(eqx.Module):
    ocp: AbstractOCP
    stages: NamedTuple
    last: NamedTuple
    Gx: Array
    Gu: Array
    GN: Array

    def objective(self, w: Point) -> Array:
        stage = jax.vmap(self.ocp.cost)(w.X[:-1], w.U, self.stages)
        return jnp.sum(stage) + self.ocp.terminal(w.X[-1], self.last)

    def misfit(self, w: Point) -> tuple[Array, Array]:
        """Return gaps minus slacks, which must vanish."""
        gaps = (
            jax.vmap(self.ocp.constraints)(w.X[:-1], w.U, self.stages),
            self.ocp.terminal_constraints(w.X[-1], self.last),
        )
        return jax.tree.map(jnp.subtract, gaps, w.slack)

    def defects(self, w: Point) -> tuple[Array, tuple[Array, Array]]:
        """Return the defects of the dynamics, and gaps minus slacks; all must vanish."""
        return jax.vmap(self.ocp.step)(w.X[:-1], w.U, self.stages) - w.X[1:], self.misfit(w)

    def barrier_objective(self, w: Point, barrier: Array) -> Array:
        """Return the objective with the barrier term."""
        return self.objective(w) - barrier * sum(jnp.sum(jnp.log(s)) for s in w.slack)

    def gap_step(self, dX: Array, dU: Array) -> tuple[Array, Array]:
        stage = jnp.einsum("kgi,ki->kg", self.Gx, dX[:-1]) + jnp.einsum("kgi,ki->kg", self.Gu, dU)
        return stage, self.GN @ dX[-1]

    def hessian(self, w: Point, costates: Array) -> tuple[Array, Array]:
        """Return the Hessians of the stages' Lagrangian in (x, u), and of the last state's cost."""
        nx = w.X.shape[1]

        def lagrangian(v, costate, p):
            return self.ocp.cost(v[:nx], v[nx:], p) + costate @ self.ocp.step(v[:nx], v[nx:], p)

        V = jnp.concatenate([w.X[:-1], w.U], axis=1)
        each = _over_stages(jax.hessian(lagrangian), V, costates, self.stages)
        return each, jax.hessian(self.ocp.terminal)(w.X[-1], self.last)


class FilterDerivatives(NamedTuple):
    """First derivatives and residuals of a problem at a point."""

    cost_x: Array  # (N, nx)
    cost_u: Array  # (N, nu)
    grad_N: Array  # (nx,) of the last state's cost
    A: Array  # (N, nx, nx)
    B: Array  # (N, nx, nu)
    dynamics: Array  # (N, nx) defects
    misfit: tuple[Array, Array]  # (N, ng), (nt,) gaps minus slacks


def _over_stages(function: Callable, *args) -> Any:
    """Apply `function` to all stages (leading axis), `TOGETHER` at once."""
    return lax.map(lambda one: function(*one), args, batch_size=TOGETHER)


def _linearise(problem: _Problem, w: Point) -> FilterDerivatives:
    ocp, stages = problem.ocp, problem.stages
    cost_x, cost_u = _over_stages(jax.grad(ocp.cost, (0, 1)), w.X[:-1], w.U, stages)
    step = lambda x, u, p: (lambda y: (y, y))(ocp.step(x, u, p))
    (A, B), y = _over_stages(jax.jacfwd(step, (0, 1), has_aux=True), w.X[:-1], w.U, stages)
    grad_N = jax.grad(ocp.terminal)(w.X[-1], problem.last)
    return FilterDerivatives(cost_x, cost_u, grad_N, A, B, y - w.X[1:], problem.misfit(w))


def _gradient(
    problem: _Problem, m: FilterDerivatives, w: Point, dual, misfit, barrier: Array
) -> tuple[Array, Array, Array]:
    """Return the right-hand side of the Newton system for given gap misfits, slacks and duals eliminated."""
    pull = jax.tree.map(lambda z, s, c: z / s * c - barrier / s, dual, w.slack, misfit)
    hx = m.cost_x + jnp.einsum("kgi,kg->ki", problem.Gx, pull[0])
    hu = m.cost_u + jnp.einsum("kgi,kg->ki", problem.Gu, pull[0])
    return hx, hu, m.grad_N + problem.GN.T @ pull[1]


def _shifted_factors(problem: _Problem, m: FilterDerivatives, loop: FilterState) -> tuple[RiccatiFactors, Array]:
    """Factorise the Newton system with the smallest shift that makes it convex (Sec. 3.1)."""
    H, HN = problem.hessian(loop.w, loop.costates)
    weight = jax.tree.map(lambda z, s: z / s, loop.dual, loop.w.slack)
    G = jnp.concatenate([problem.Gx, problem.Gu], axis=2)
    H = H + jnp.einsum("kgi,kg,kgj->kij", G, weight[0], G)
    HN = HN + (problem.GN.T * weight[1]) @ problem.GN
    nx, nu = HN.shape[0], m.B.shape[2]

    def attempt(carry):
        shift, last, count = carry
        first = jnp.where(loop.shift > 0, jnp.maximum(1e-8, loop.shift / 3), FIRST_SHIFT)
        more = jnp.where(count == 1, jnp.maximum(first, 8 * shift), 8 * shift)
        shift = jnp.where(count == 0, shift, more)
        Hs = H + shift * jnp.eye(H.shape[-1])
        blocks = NewtonMatrices(Hs[:, :nx, :nx], Hs[:, nx:, :nx], Hs[:, nx:, nx:], m.A, m.B, HN + shift * jnp.eye(nx))
        return shift, factorise(blocks), count + 1

    indefinite = lambda carry: ~carry[1].convex & (carry[0] < LARGEST_SHIFT)
    none = RiccatiFactors(
        jnp.zeros((len(H), nu, nx)), jnp.zeros((len(H), nu, nu)), jnp.zeros_like(m.A), jnp.asarray(False)
    )
    shift, factors, _ = lax.while_loop(indefinite, attempt, (loop.floor, none, jnp.zeros((), int)))
    return factors, shift


def _to_boundary(values, steps, share: Array) -> Array:
    rates = [jnp.max(-d / v, initial=0.0) for v, d in zip(values, steps, strict=True)]
    return jnp.minimum(1.0, share / jnp.maximum(jnp.max(jnp.stack(rates)), 1e-12))


def _violation(dynamics: Array, misfit: tuple[Array, Array]) -> Array:
    """Return the total constraint violation."""
    return jnp.sum(jnp.abs(dynamics)) + sum(jnp.sum(jnp.abs(c)) for c in misfit)


class NewtonStep(NamedTuple):
    """Newton step of the primal variables, and the costates after it."""

    d: Point
    costates: Array  # (N, nx) after the full step


def _step(
    problem: _Problem, m: FilterDerivatives, factors: RiccatiFactors, loop: FilterState, dynamics: Array, misfit
) -> NewtonStep:
    hx, hu, hN = _gradient(problem, m, loop.w, loop.dual, misfit, loop.barrier)
    dX, dU, costates = solve_factored(factors, m.A, m.B, dynamics, hx, hu, hN)
    d_slack = jax.tree.map(jnp.add, problem.gap_step(dX, dU), misfit)
    return NewtonStep(Point(dX, dU, d_slack), costates)


def _along(w: Point, d: Point, length: Array) -> Point:
    return jax.tree.map(lambda y, dy: y + length * dy, w, d)


class FilterTrial(NamedTuple):
    """A trial point of the line search."""

    w: Point
    dynamics: Array  # defects there
    misfit: tuple[Array, Array]
    ok: Array
    descent: Array  # whether the step promises descent, so that the objective decides
    length: Array  # of the plain step that it is, or corrects
    reach: Array  # of the step taken
    number: Array


def _search(
    problem: _Problem, m: FilterDerivatives, factors: RiccatiFactors, loop: FilterState, step: NewtonStep
) -> tuple[FilterTrial, Array]:
    """Run the filter line search (Sec. 2.3) and update the filter; the second trial may be a correction (Sec. 2.4)."""
    w, barrier, d = loop.w, loop.barrier, step.d
    theta, phi = _violation(m.dynamics, m.misfit), problem.barrier_objective(w, barrier)
    slope = jnp.sum(m.cost_x * d.X[:-1]) + jnp.sum(m.cost_u * d.U) + m.grad_N @ d.X[-1]
    slope = slope - barrier * sum(jnp.sum(ds / s) for s, ds in zip(w.slack, d.slack, strict=True))
    share = jnp.maximum(0.99, 1 - barrier)
    longest = _to_boundary(w.slack, d.slack, share)
    small = 1e-4 * jnp.maximum(1.0, loop.entries[0, 0] / 1e4)
    rounding = 1e-13 * jnp.abs(phi)

    def acceptable(length, theta_new, phi_new):
        outside = jnp.all((theta_new < (1 - GAMMA) * loop.entries[:, 0]) | (phi_new < loop.entries[:, 1]))
        descent = (slope < 0) & (theta <= small)
        descent &= length * jnp.abs(slope) ** 2.3 > theta**1.1
        armijo = phi_new <= phi + ARMIJO * length * slope + rounding
        progress = (theta_new <= (1 - GAMMA) * theta) | (phi_new <= phi - GAMMA * theta + rounding)
        finite = jnp.isfinite(theta_new) & jnp.isfinite(phi_new)
        return finite & outside & jnp.where(descent, armijo, progress), descent

    def corrected(last: FilterTrial) -> tuple[Point, Array]:
        dynamics = longest * m.dynamics + last.dynamics
        misfit = jax.tree.map(lambda c, new: longest * c + new, m.misfit, last.misfit)
        second = _step(problem, m, factors, loop, dynamics, misfit).d
        reach = _to_boundary(w.slack, second.slack, share)
        return _along(w, second, reach), reach

    def attempt(last: FilterTrial) -> FilterTrial:
        correct = (last.number == 1) & ~(_violation(last.dynamics, last.misfit) < theta)
        length = jnp.where((last.number == 0) | correct, longest, last.length / 2)
        point, reach = lax.cond(correct, corrected, lambda _: (_along(w, d, length), length), last)
        dynamics, misfit = problem.defects(point)
        good, descent = acceptable(length, _violation(dynamics, misfit), problem.barrier_objective(point, barrier))
        return FilterTrial(point, dynamics, misfit, good, descent, length, reach, last.number + 1)

    none, no = jnp.zeros((), int), jnp.asarray(False)
    first = FilterTrial(w, m.dynamics, m.misfit, no, no, longest, longest, none)
    trial = lax.while_loop(lambda t: ~t.ok & (t.number < TRIALS), attempt, first)
    corner = jnp.stack([(1 - GAMMA) * theta, phi - GAMMA * theta])
    entries = jnp.concatenate([loop.entries[:1], corner[None], loop.entries[1:-1]])
    return trial, jnp.where(trial.ok & ~trial.descent, entries, loop.entries)


def _errors(
    problem: _Problem, m: FilterDerivatives, w: Point, costates: Array, dual, barrier: Array
) -> tuple[Array, Array]:
    """Return the scaled optimality error (Eq. 5) for a barrier parameter, and the worst violation."""
    before = jnp.concatenate([jnp.zeros_like(costates[:1]), costates[:-1]])
    along_x = (
        m.cost_x + jnp.einsum("kij,ki->kj", m.A, costates) - before - jnp.einsum("kgi,kg->ki", problem.Gx, dual[0])
    )
    along_u = m.cost_u + jnp.einsum("kij,ki->kj", m.B, costates) - jnp.einsum("kgi,kg->ki", problem.Gu, dual[0])
    end = m.grad_N - costates[-1] - problem.GN.T @ dual[1]
    sizes = [jnp.sum(jnp.abs(y)) for y in (costates, *dual)]
    mean = sum(sizes) / (costates.size + sum(z.size for z in dual))
    mean_dual = (sizes[1] + sizes[2]) / sum(z.size for z in dual)
    products = jnp.stack([jnp.max(jnp.abs(s * z - barrier), initial=0.0) for s, z in zip(w.slack, dual, strict=True)])
    stationarity = jnp.max(jnp.stack([jnp.max(jnp.abs(v)) for v in (along_x[1:], along_u, end)]))
    violation = jnp.stack([jnp.max(jnp.abs(c), initial=0.0) for c in (m.dynamics, *m.misfit)])
    large = 100.0
    kkt = jnp.maximum(
        stationarity / jnp.maximum(1.0, mean / large), jnp.max(products) / jnp.maximum(1.0, mean_dual / large)
    )
    return kkt, jnp.max(violation)


def _judge(problem: _Problem, m: FilterDerivatives, loop: FilterState, options: Options) -> FilterState:
    """Evaluate the iterate; reduce the barrier parameter once its problem is solved accurately enough."""
    w, barrier = loop.w, loop.barrier
    kkt, violation = _errors(problem, m, w, loop.costates, loop.dual, jnp.zeros_like(barrier))
    error = jnp.max(jnp.stack(_errors(problem, m, w, loop.costates, loop.dual, barrier)))
    solved = loop.moved & (error <= 10 * barrier)  # (Eq. 7)
    lower = jnp.maximum(options.tolerance / 10, jnp.minimum(0.2 * barrier, barrier**1.5))
    fresh = jnp.full_like(loop.entries, jnp.inf).at[0, 0].set(loop.entries[0, 0])
    entries = jnp.where(solved | ~loop.moved, fresh, loop.entries)
    open_ = ~(jnp.maximum(kkt, violation) <= options.tolerance)
    open_ &= (loop.num_steps < options.max_steps) & (loop.failures < GIVE_UP)
    return loop._replace(
        barrier=jnp.where(solved, lower, barrier), entries=entries, kkt=kkt, violation=violation, open=open_
    )


def _move(problem: _Problem, m: FilterDerivatives, loop: FilterState) -> FilterState:
    """Return the next iterate; the same one where no step was acceptable."""
    w, barrier = loop.w, loop.barrier
    factors, shift = _shifted_factors(problem, m, loop)
    step = _step(problem, m, factors, loop, m.dynamics, m.misfit)
    share = jnp.maximum(0.99, 1 - barrier)
    d_dual = jax.tree.map(lambda s, z, ds: barrier / s - z - z / s * ds, w.slack, loop.dual, step.d.slack)
    trial, entries = _search(problem, m, factors, loop, step)
    reach, ok = _to_boundary(loop.dual, d_dual, share), trial.ok
    dual = jax.tree.map(lambda z, dz: z + reach * dz, loop.dual, d_dual)
    dual = jax.tree.map(lambda z, s: jnp.clip(z, barrier / s / 1e10, barrier / s * 1e10), dual, trial.w.slack)
    costates = loop.costates + trial.reach * (step.costates - loop.costates)
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(ok, a, b), new, old)
    w, costates, dual = keep((trial.w, costates, dual), (loop.w, loop.costates, loop.dual))
    failures = jnp.where(ok, 0, loop.failures + 1)
    floor = jnp.where(ok, 0.0, jnp.maximum(1e-3, 10 * jnp.maximum(shift, loop.floor)))
    return loop._replace(w=w, costates=costates, dual=dual, shift=shift, floor=floor, entries=entries,
                         failures=failures, num_steps=loop.num_steps + 1, moved=ok)  # fmt: skip


def _iterate(problem: _Problem, loop: FilterState, options: Options) -> FilterState:
    """Evaluate the iterate and step from it; derivatives appear here once, which halves the program."""
    m = _linearise(problem, loop.w)
    loop = _judge(problem, m, loop, options)
    return lax.cond(loop.open, lambda: _move(problem, m, loop), lambda: loop)


def solve_with_filter(
    ocp: AbstractOCP, x0: Array, params: NamedTuple, X: Array, U: Array, options: Options
) -> Solution:
    """Solve one problem by a filter line search from the guess `X` (N+1, nx), `U` (N, nu).

    `params` has N+1 rows, the last for the end. Same problem and solution as `driftjax.solve.solve`. `result` is
    `successful` only where KKT residual and violation are below the tolerance; `stalled` where no step is acceptable
    any more.
    """
    stages, last = jax.tree.map(lambda p: p[:-1], params), jax.tree.map(lambda p: p[-1], params)
    Gx, Gu = jax.vmap(jax.jacfwd(ocp.constraints, (0, 1)))(X[:-1], U, stages)
    GN = jax.jacfwd(ocp.terminal_constraints)(X[-1], last)
    problem = _Problem(ocp, stages, last, Gx, Gu, GN)
    X = X.at[0].set(x0)
    gaps = jax.vmap(ocp.constraints)(X[:-1], U, stages), ocp.terminal_constraints(X[-1], last)
    w = Point(X, U, jax.tree.map(lambda g: jnp.maximum(g, SLACK_START), gaps))
    dual = jax.tree.map(lambda s: options.barrier / s, w.slack)
    theta = _violation(*problem.defects(w))
    zero, count = jnp.zeros((), X.dtype), jnp.zeros((), int)
    entries = jnp.full((FILTER_SIZE, 2), jnp.inf).at[0, 0].set(1e4 * jnp.maximum(1.0, theta))  # (Eq. 21)
    large, moved, open_ = zero + jnp.inf, jnp.asarray(False), jnp.asarray(True)
    loop = FilterState(w, jnp.zeros_like(X[1:]), dual, options.barrier, zero, zero, entries, count, count, large, large,
                       moved, open_)  # fmt: skip
    end = lax.while_loop(lambda s: s.open, lambda s: _iterate(problem, s, options), loop)
    done = jnp.maximum(end.kkt, end.violation) <= options.tolerance
    failed = RESULTS.where(end.failures >= GIVE_UP, RESULTS.stalled, RESULTS.not_converged)
    failed = RESULTS.where(jnp.isfinite(end.kkt) & jnp.isfinite(end.violation), failed, RESULTS.non_finite)
    result = RESULTS.where(done, RESULTS.successful, failed)  # pyright: ignore[reportArgumentType]
    return Solution(end.w.X, end.w.U, problem.objective(end.w), end.kkt, end.violation, end.num_steps, result)
