"""A filter line-search interior point for long, strongly nonlinear stage-wise problems.

The drift MPC's solver walks on roll-outs and an l1 merit function, which suits short horizons solved from warm
starts. A minimum-time plan starts far from feasible over hundreds of stages; there the filter method with inertia
correction is the more dependable (Waechter and Biegler 2006, "On the implementation of an interior-point filter
line-search algorithm", Math. Program. 106; equations below are its). No restoration phase: where no trial step is
acceptable the Hessian is shifted, which turns the step towards feasibility.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax

from driftjax.core import RESULTS
from driftjax.plan.sweep import Quadratic, Sweep, factor, substitute
from driftjax.solve import AbstractOCP, Options
from driftjax.solve import Plan as Solution

SLACK_START = 1e-2  # least slack of a gap at the start
FILTER_SIZE = 60  # entries; the oldest give way
GAMMA = 1e-5  # margin of the filter (Eq. 18)
ARMIJO = 1e-4  # (Eq. 20)
TRIALS = 9  # step lengths tried, each half of the last
GIVE_UP = 8  # iterations in a row without an acceptable step
FIRST_SHIFT, LARGEST_SHIFT = 1e-4, 1e10  # of the Hessian (Sec. 3.1)


class Point(NamedTuple):
    """Primal variables; slack of the stages' gaps (N, ng) and of the last state's (nt,)."""

    X: Array
    U: Array
    slack: tuple[Array, Array]


class Loop(NamedTuple):
    w: Point
    costates: Array
    dual: tuple[Array, Array]
    barrier: Array
    shift: Array  # last Hessian shift that was needed
    floor: Array  # least shift to use, raised by failed searches
    entries: Array  # filter: forbidden (violation, objective) corners
    failures: Array
    num_steps: Array
    kkt: Array
    violation: Array


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

    def defects(self, w: Point) -> tuple[Array, tuple[Array, Array]]:
        """What has to vanish: the dynamics' defects, and gaps minus slacks."""
        gaps = (
            jax.vmap(self.ocp.constraints)(w.X[:-1], w.U, self.stages),
            self.ocp.terminal_constraints(w.X[-1], self.last),
        )
        dynamics = jax.vmap(self.ocp.step)(w.X[:-1], w.U, self.stages) - w.X[1:]
        return dynamics, jax.tree.map(jnp.subtract, gaps, w.slack)

    def gap_step(self, dX: Array, dU: Array) -> tuple[Array, Array]:
        stage = jnp.einsum("kgi,ki->kg", self.Gx, dX[:-1]) + jnp.einsum("kgi,ki->kg", self.Gu, dU)
        return stage, self.GN @ dX[-1]

    def hessian(self, w: Point, costates: Array) -> tuple[Array, Array]:
        """Hessians of the stages' Lagrangian in (x, u), and of the last state's cost."""
        nx = w.X.shape[1]

        def lagrangian(v, costate, p):
            return self.ocp.cost(v[:nx], v[nx:], p) + costate @ self.ocp.step(v[:nx], v[nx:], p)

        V = jnp.concatenate([w.X[:-1], w.U], axis=1)
        return jax.vmap(jax.hessian(lagrangian))(V, costates, self.stages), jax.hessian(self.ocp.terminal)(
            w.X[-1], self.last
        )


class Model(NamedTuple):
    cost_x: Array
    cost_u: Array
    grad_N: Array
    A: Array
    B: Array
    dynamics: Array
    misfit: tuple[Array, Array]


def _linearise(problem: _Problem, w: Point) -> Model:
    ocp, stages = problem.ocp, problem.stages
    cost_x, cost_u = jax.vmap(jax.grad(ocp.cost, (0, 1)))(w.X[:-1], w.U, stages)
    A, B = jax.vmap(jax.jacfwd(ocp.step, (0, 1)))(w.X[:-1], w.U, stages)
    return Model(cost_x, cost_u, jax.grad(ocp.terminal)(w.X[-1], problem.last), A, B, *problem.defects(w))


def _gradient(problem: _Problem, m: Model, w: Point, dual, misfit, barrier: Array) -> tuple[Array, Array, Array]:
    """Right-hand side of the Newton system for given gap misfits, slacks and duals eliminated."""
    pull = jax.tree.map(lambda z, s, c: z / s * c - barrier / s, dual, w.slack, misfit)
    hx = m.cost_x + jnp.einsum("kgi,kg->ki", problem.Gx, pull[0])
    hu = m.cost_u + jnp.einsum("kgi,kg->ki", problem.Gu, pull[0])
    return hx, hu, m.grad_N + problem.GN.T @ pull[1]


def _factor(problem: _Problem, m: Model, loop: Loop) -> tuple[Sweep, Array]:
    """Factorised Newton system with the least shift that makes it convex (Sec. 3.1)."""
    H, HN = problem.hessian(loop.w, loop.costates)
    weight = jax.tree.map(lambda z, s: z / s, loop.dual, loop.w.slack)
    G = jnp.concatenate([problem.Gx, problem.Gu], axis=2)
    H = H + jnp.einsum("kgi,kg,kgj->kij", G, weight[0], G)
    HN = HN + (problem.GN.T * weight[1]) @ problem.GN
    nx = HN.shape[0]

    def attempt(shift):
        Hs = H + shift * jnp.eye(H.shape[-1])
        return factor(Quadratic(Hs[:, :nx, :nx], Hs[:, nx:, :nx], Hs[:, nx:, nx:], m.A, m.B, HN + shift * jnp.eye(nx)))

    def raise_shift(carry):
        shift, _ = carry
        first = jnp.where(loop.shift > 0, jnp.maximum(1e-8, loop.shift / 3), FIRST_SHIFT)
        shift = jnp.where(shift == loop.floor, jnp.maximum(first, 8 * shift), 8 * shift)
        return shift, attempt(shift)

    indefinite = lambda carry: ~carry[1].convex & (carry[0] < LARGEST_SHIFT)
    shift, sweep = lax.while_loop(indefinite, raise_shift, (loop.floor, attempt(loop.floor)))
    return sweep, shift


def _to_boundary(values, steps, share: Array) -> Array:
    rates = [jnp.max(-d / v, initial=0.0) for v, d in zip(values, steps, strict=True)]
    return jnp.minimum(1.0, share / jnp.maximum(jnp.max(jnp.stack(rates)), 1e-12))


def _merit(problem: _Problem, w: Point, barrier: Array) -> tuple[Array, Array]:
    """Total violation, and barrier objective."""
    dynamics, misfit = problem.defects(w)
    violation = jnp.sum(jnp.abs(dynamics)) + sum(jnp.sum(jnp.abs(c)) for c in misfit)
    return violation, problem.objective(w) - barrier * sum(jnp.sum(jnp.log(s)) for s in w.slack)


class Step(NamedTuple):
    d: Point
    costates: Array  # after the full step


def _step(problem: _Problem, m: Model, sweep: Sweep, loop: Loop, dynamics: Array, misfit) -> Step:
    hx, hu, hN = _gradient(problem, m, loop.w, loop.dual, misfit, loop.barrier)
    dX, dU, costates = substitute(sweep, m.A, m.B, dynamics, hx, hu, hN)
    d_slack = jax.tree.map(jnp.add, problem.gap_step(dX, dU), misfit)
    return Step(Point(dX, dU, d_slack), costates)


def _along(w: Point, d: Point, length: Array) -> Point:
    return jax.tree.map(lambda y, dy: y + length * dy, w, d)


def _search(problem: _Problem, m: Model, sweep: Sweep, loop: Loop, step: Step):
    """Filter line search (Sec. 2.3) with one second-order correction (Sec. 2.4)."""
    w, barrier, d = loop.w, loop.barrier, step.d
    theta, phi = _merit(problem, w, barrier)
    slope = jnp.sum(m.cost_x * d.X[:-1]) + jnp.sum(m.cost_u * d.U) + m.grad_N @ d.X[-1]
    slope = slope - barrier * sum(jnp.sum(ds / s) for s, ds in zip(w.slack, d.slack, strict=True))
    share = jnp.maximum(0.99, 1 - barrier)
    longest = _to_boundary(w.slack, d.slack, share)
    small = 1e-4 * jnp.maximum(1.0, loop.entries[0, 0] / 1e4)
    rounding = 1e-13 * jnp.abs(phi)

    def acceptable(length, trial):
        theta_new, phi_new = _merit(problem, trial, barrier)
        outside = jnp.all((theta_new < (1 - GAMMA) * loop.entries[:, 0]) | (phi_new < loop.entries[:, 1]))
        descent = (slope < 0) & (theta <= small)
        descent &= length * jnp.abs(slope) ** 2.3 > theta**1.1
        armijo = phi_new <= phi + ARMIJO * length * slope + rounding
        progress = (theta_new <= (1 - GAMMA) * theta) | (phi_new <= phi - GAMMA * theta + rounding)
        finite = jnp.isfinite(theta_new) & jnp.isfinite(phi_new)
        return finite & outside & jnp.where(descent, armijo, progress), descent, theta_new

    def corrected(_):
        trial = _along(w, d, longest)
        dynamics, misfit = problem.defects(trial)
        dynamics = longest * m.dynamics + dynamics
        misfit = jax.tree.map(lambda c, new: longest * c + new, m.misfit, misfit)
        second = _step(problem, m, sweep, loop, dynamics, misfit)
        reach = _to_boundary(w.slack, second.d.slack, share)
        trial = _along(w, second.d, reach)
        ok, descent, _ = acceptable(longest, trial)
        return ok, reach, trial, descent

    def halve(carry):
        _, length, _, _, count = carry
        trial = _along(w, d, length / 2)
        ok, descent, _ = acceptable(length / 2, trial)
        return ok, length / 2, trial, descent, count + 1

    first = _along(w, d, longest)
    ok, descent, theta_first = acceptable(longest, first)
    plain = (ok, longest, first, descent)
    ok, length, trial, descent = lax.cond(~ok & ~(theta_first < theta), corrected, lambda _: plain, None)
    length = jnp.where(ok, length, longest)
    go_on = lambda carry: ~carry[0] & (carry[4] < TRIALS)
    ok, length, trial, descent, _ = lax.while_loop(go_on, halve, (ok, length, trial, descent, 0))
    corner = jnp.stack([(1 - GAMMA) * theta, phi - GAMMA * theta])
    entries = jnp.concatenate([loop.entries[:1], corner[None], loop.entries[1:-1]])
    entries = jnp.where(ok & ~descent, entries, loop.entries)
    return ok, length, trial, entries


def _errors(problem: _Problem, m: Model, w: Point, costates: Array, dual, barrier: Array) -> tuple[Array, Array]:
    """Scaled optimality error (Eq. 5) for a barrier parameter, and worst violation."""
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


def _iterate(problem: _Problem, loop: Loop, options: Options) -> Loop:
    w, barrier = loop.w, loop.barrier
    m = _linearise(problem, w)
    sweep, shift = _factor(problem, m, loop)
    step = _step(problem, m, sweep, loop, m.dynamics, m.misfit)
    share = jnp.maximum(0.99, 1 - barrier)
    d_dual = jax.tree.map(lambda s, z, ds: barrier / s - z - z / s * ds, w.slack, loop.dual, step.d.slack)
    ok, length, trial, entries = _search(problem, m, sweep, loop, step)
    reach = _to_boundary(loop.dual, d_dual, share)
    dual = jax.tree.map(lambda z, dz: z + reach * dz, loop.dual, d_dual)
    dual = jax.tree.map(lambda z, s: jnp.clip(z, barrier / s / 1e10, barrier / s * 1e10), dual, trial.slack)
    costates = loop.costates + length * (step.costates - loop.costates)
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(ok, a, b), new, old)
    w, costates, dual = keep((trial, costates, dual), (loop.w, loop.costates, loop.dual))
    m = _linearise(problem, w)
    kkt, violation = _errors(problem, m, w, costates, dual, jnp.zeros_like(barrier))
    error = jnp.max(jnp.stack(_errors(problem, m, w, costates, dual, barrier)))
    solved = ok & (error <= 10 * barrier)  # (Eq. 7)
    lower = jnp.maximum(options.tolerance / 10, jnp.minimum(0.2 * barrier, barrier**1.5))
    fresh = jnp.full_like(entries, jnp.inf).at[0, 0].set(entries[0, 0])
    failures = jnp.where(ok, 0, loop.failures + 1)
    floor = jnp.where(ok, 0.0, jnp.maximum(1e-3, 10 * jnp.maximum(shift, loop.floor)))
    return Loop(w, costates, dual, jnp.where(solved, lower, barrier), shift, floor,
                jnp.where(solved | ~ok, fresh, entries), failures, loop.num_steps + 1, kkt, violation)  # fmt: skip


def solve(ocp: AbstractOCP, x0: Array, params: NamedTuple, X: Array, U: Array, options: Options) -> Solution:
    """Solve one problem from the guess `X` (N+1, nx), `U` (N, nu); `params` has N+1 rows, the last for the end.

    Same problem and answer as `driftjax.solve.solve`. `result` is `successful` only where KKT residual and
    violation are below the tolerance; `stalled` where no step is acceptable any more.
    """
    stages, last = jax.tree.map(lambda p: p[:-1], params), jax.tree.map(lambda p: p[-1], params)
    Gx, Gu = jax.vmap(jax.jacfwd(ocp.constraints, (0, 1)))(X[:-1], U, stages)
    GN = jax.jacfwd(ocp.terminal_constraints)(X[-1], last)
    problem = _Problem(ocp, stages, last, Gx, Gu, GN)
    X = X.at[0].set(x0)
    gaps = jax.vmap(ocp.constraints)(X[:-1], U, stages), ocp.terminal_constraints(X[-1], last)
    w = Point(X, U, jax.tree.map(lambda g: jnp.maximum(g, SLACK_START), gaps))
    dual = jax.tree.map(lambda s: options.barrier / s, w.slack)
    theta, _ = _merit(problem, w, options.barrier)
    zero, count = jnp.zeros((), X.dtype), jnp.zeros((), int)
    entries = jnp.full((FILTER_SIZE, 2), jnp.inf).at[0, 0].set(1e4 * jnp.maximum(1.0, theta))  # (Eq. 21)
    loop = Loop(w, jnp.zeros_like(X[1:]), dual, options.barrier, zero, zero, entries, count, count, zero + jnp.inf,
                zero + jnp.inf)  # fmt: skip

    def unfinished(s: Loop) -> Array:
        open_ = ~(jnp.maximum(s.kkt, s.violation) <= options.tolerance)
        return open_ & (s.num_steps < options.max_steps) & (s.failures < GIVE_UP)

    end = lax.while_loop(unfinished, lambda s: _iterate(problem, s, options), loop)
    done = jnp.maximum(end.kkt, end.violation) <= options.tolerance
    failed = RESULTS.where(end.failures >= GIVE_UP, RESULTS.stalled, RESULTS.not_converged)
    failed = RESULTS.where(jnp.isfinite(end.kkt) & jnp.isfinite(end.violation), failed, RESULTS.non_finite)
    result = RESULTS.where(done, RESULTS.successful, failed)  # pyright: ignore[reportArgumentType]
    return Solution(end.w.X, end.w.U, problem.objective(end.w), end.kkt, end.violation, end.num_steps, result)
