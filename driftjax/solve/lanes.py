"""Optimal control problems in batches: a primal-dual interior point, many lanes at once, batch on the last axis.

Every iteration linearises the dynamics anew with the Hessian of the Lagrangian, solves the barrier problem's Newton
system by one Riccati sweep and goes to the boundary by a fraction. There is no line search: nearly all lanes of a
tracking problem converge from a fair guess in about ten iterations, the others say so in `result`, and the safeguarded
`solve` takes them. Everything is elementwise along the batch, so that a CPU fills its vector registers with lanes.
Sources: Waechter and Biegler 2006 (barrier, fraction to the boundary, error scaling).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PyTree

from driftjax.core import RESULTS
from driftjax.core.materialise import materialised
from driftjax.solve.interior_point import BOUNDARY_FRACTION, SLACK_FLOOR, split
from driftjax.solve.lane_ocp import AbstractLanes, Components
from driftjax.solve.ocp import Options
from driftjax.solve.sparse import Entry, column, dot, hessian, total
from driftjax.solve.stage import Local, Policy, Value, backward, forward


class Lanes(NamedTuple):
    """Iterate: components (stages, batch); slacks and duals of each limit in the order of `_gaps`."""

    X: Components  # (N+1, batch)
    U: Components  # (N, batch)
    costates: Components  # (N, batch), of the dynamics into x_1..x_N
    slack: Components  # (N, batch)
    dual: Components


class LanePlans(eqx.Module):
    """Solutions of a batch; components on the first axis, the batch on the last."""

    X: Float[Array, "nx N+1 batch"]
    U: Float[Array, "nu N batch"]
    costates: Float[Array, "nx N batch"]
    dual: Float[Array, "ng N batch"]
    cost: Float[Array, " batch"]  # objective at (X, U)
    kkt: Float[Array, " batch"]  # scaled stationarity and complementarity [-]
    violation: Float[Array, " batch"]  # worst defect or violation of a limit
    num_steps: Array  # iterations of the slowest lane
    result: RESULTS


class _Gap(NamedTuple):
    """sign (y - bound) >= 0 for an entry of a family of variables."""

    family: str
    entry: int
    sign: float
    bound: Array | float


def _gaps(ocp: AbstractLanes) -> list[_Gap]:
    families = (("input", ocp.input_limits()), ("change", ocp.change_limits()), ("state", ocp.state_limits()))
    return [
        _Gap(family, i, sign, bound)
        for family, limits in families
        for i, pair in enumerate(limits)
        for sign, bound in zip((1.0, -1.0), pair, strict=True)
        if bound is not None
    ]


def _measured(gaps: list[_Gap], u: Components, change: Components, x_next: Components) -> Components:
    of = {"input": u, "change": change, "state": x_next}
    return [gap.sign * (of[gap.family][gap.entry] - gap.bound) for gap in gaps]


class _Stage(NamedTuple):
    """What one stage of the sweep reads."""

    x: Components
    u: Components
    before: Components  # input of the stage before
    after: Components  # state of the stage after, in the guess
    costate: Components
    slack: Components
    dual: Components
    p: Any
    around: Any


class _Swept(NamedTuple):
    """Carried backwards: value, and what the stage after contributes to the stationarity of this one."""

    value: Value
    gradient: Components  # of the Lagrangian in the state after, without its costate
    change: Components  # of the Lagrangian in the change of the input after
    error: Array
    violation: Array
    size: Array  # sum of the absolute multipliers


def _worst(start: Array, values: Sequence[Entry]) -> Array:
    for value in values:
        start = start if value is None else jnp.maximum(start, jnp.abs(value))
    return start


def _filled(entries: Any, like: Array) -> Any:
    """Zeros in place of None."""
    return jax.tree.map(lambda e: jnp.zeros_like(like) if e is None else e, entries, is_leaf=lambda e: e is None)


def _stage_back(ocp: AbstractLanes, barrier: Array, carry: _Swept, s: _Stage):
    gaps, nx, nu = _gaps(ocp), len(s.x), len(s.u)
    one = s.u[0]
    change = [a - b for a, b in zip(s.u, s.before, strict=True)]
    g = _measured(gaps, s.u, change, s.after)
    y, M = ocp.linearise(s.x, s.u, s.p, s.around)
    defect = [a - b for a, b in zip(y, s.after, strict=True)]
    h, H = hessian(lambda *z: ocp.cost(list(z[:nx]), list(z[nx:]), s.p), *s.x, *s.u)
    bend = ocp.curvature(s.x, s.u, s.costate, s.p, s.around)
    H = [[total((a, b)) for a, b in zip(p, q, strict=True)] for p, q in zip(H, bend, strict=True)]
    weight = ocp.rate_weight() or [0.0] * nu
    inv = [1 / slack for slack in s.slack]
    stiff = [z * i for z, i in zip(s.dual, inv, strict=True)]
    pull = [w * (gap - slack) - barrier * i for w, gap, slack, i in zip(stiff, g, s.slack, inv, strict=True)]

    def of(family: str, index: int, values: Components, signed: bool) -> list[Entry]:
        return [gap.sign * v if signed else v for gap, v in zip(gaps, values, strict=True)
                if (gap.family, gap.entry) == (family, index)]  # fmt: skip

    moved = [2 * weight[l] * change[l] for l in range(nu)]
    system = Local(
        A=[row[:nx] for row in M],
        B=[row[nx:] for row in M],
        c=defect,
        H=[[total((H[i][j], *(of("input", i - nx, stiff, False) if i == j >= nx else ()))) for j in range(nx + nu)]
           for i in range(nx + nu)],
        h=[total((h[i], *(of("input", i - nx, pull, True) if i >= nx else ()))) for i in range(nx + nu)],
        rate=[total((2 * weight[l] + jnp.zeros_like(one), *of("change", l, stiff, False))) for l in range(nu)],
        pull=[total((moved[l], *of("change", l, pull, True))) for l in range(nu)],
    )  # fmt: skip
    # limits of the state after belong to its value
    P = [[total((carry.value.P[i][j], *(of("state", i, stiff, False) if i == j else ()))) for j in range(nx)]
         for i in range(nx)]  # fmt: skip
    p = [total((carry.value.p[i], *of("state", i, pull, True))) for i in range(nx)]
    value, policy = backward(carry.value._replace(P=P, p=p), system)
    # stationarity in the state after, the input, the change of the input
    held = lambda family, i: [-e for e in of(family, i, s.dual, True)]
    rx = [total((carry.gradient[i], -s.costate[i], *held("state", i))) for i in range(nx)]
    rw = [total((moved[l], *held("change", l))) for l in range(nu)]
    ru = [total((h[nx + l], dot(column(system.B, l), s.costate), *held("input", l), rw[l], -carry.change[l]))
          for l in range(nu)]  # fmt: skip
    gradient = [total((h[i], dot(column(system.A, i), s.costate))) for i in range(nx)]
    products = [slack * z for slack, z in zip(s.slack, s.dual, strict=True)]
    misfit = [gap - slack for gap, slack in zip(g, s.slack, strict=True)]
    value, gradient, rw = _filled((value, gradient, rw), one)
    swept = _Swept(
        value,
        gradient,
        rw,
        _worst(carry.error, (*rx, *ru, *products)),
        _worst(carry.violation, (*defect, *misfit)),
        carry.size + total(jnp.abs(v) for v in (*s.costate, *s.dual)),
    )
    return swept, _filled(((policy, system.A, system.B, defect), (p, P, carry.value.S), misfit), one)


class _Ahead(NamedTuple):
    """Carried forwards: steps of state and input before, longest rates of approach to a bound."""

    dx: Components
    dw: Components
    primal: Array
    dual: Array


def _stage_forth(ocp: AbstractLanes, barrier: Array, carry: _Ahead, given):
    (policy, A, B, defect), (p, P, S), misfit, slack, dual = given
    gaps = _gaps(ocp)
    dx, du = forward(Policy(*policy), Local(A, B, defect, [], [], [None] * len(carry.dw), []), carry.dx, carry.dw)
    costate = [total((p[i], dot(P[i], dx), dot(S[i], du))) for i in range(len(dx))]
    of = {"input": du, "change": [a - b for a, b in zip(du, carry.dw, strict=True)], "state": dx}
    d_slack, d_dual, primal, ahead = [], [], carry.primal, carry.dual
    for gap, r, s, z in zip(gaps, misfit, slack, dual, strict=True):
        over = 1 / s
        ds = gap.sign * of[gap.family][gap.entry] + r
        dz = barrier * over - z - z * over * ds
        primal, ahead = jnp.maximum(primal, -ds * over), jnp.maximum(ahead, -dz / z)
        d_slack.append(ds)
        d_dual.append(dz)
    return _Ahead(dx, du, primal, ahead), (dx, du, costate, d_slack, d_dual)


class _Loop(NamedTuple):
    lanes: Lanes
    barrier: Array
    kkt: Array
    violation: Array
    num_steps: Array


def _before(U: Components, u_before: Components) -> Components:
    return [jnp.concatenate([b[None], u[:-1]]) for u, b in zip(U, u_before, strict=True)]


def _open(kkt: Array, violation: Array, tolerance: Array, needed: Array) -> Array:
    """Lanes still to be solved; one that is not a number any more holds up none."""
    error = jnp.maximum(kkt, violation)
    return needed & ~(error <= tolerance) & ~jnp.isnan(error)


def _iterate(
    ocp: AbstractLanes, stages: PyTree, last: PyTree, u_before: Components, tolerance: Array, needed: Array, loop: _Loop
):
    it, barrier = loop.lanes, loop.barrier
    zero = jnp.zeros_like(barrier)
    nx, nu = len(it.X), len(it.U)
    end = [x[-1] for x in it.X]
    grad, P = _filled(hessian(lambda *x: ocp.terminal(list(x), last), *end), zero)
    blank = lambda n, m: [[zero] * m for _ in range(n)]
    begin = _Swept(Value(P, blank(nx, nu), blank(nu, nu), grad, [zero] * nu), grad, [zero] * nu, zero, zero, zero)
    head, tail = [x[:-1] for x in it.X], [x[1:] for x in it.X]
    around = materialised(ocp.around)(head, it.U, stages)
    read = _Stage(head, it.U, _before(it.U, u_before), tail, it.costates, it.slack, it.dual, stages, around)
    back = materialised(lambda carry, s: _stage_back(ocp, barrier, carry, s))
    swept, (system, ahead, misfit) = jax.lax.scan(back, begin, read, reverse=True)
    num = it.costates[0].shape[0] * (nx + len(it.dual))
    kkt = swept.error / jnp.maximum(1.0, swept.size / num / 100)
    forth = materialised(lambda carry, s: _stage_forth(ocp, barrier, carry, s))
    start = _Ahead([zero] * nx, [zero] * nu, zero, zero)
    reached, (dX, dU, costates, d_slack, d_dual) = jax.lax.scan(
        forth, start, (system, ahead, misfit, it.slack, it.dual)
    )
    tiny = 1e-12
    open_ = _open(kkt, swept.violation, tolerance, needed)
    step = jnp.where(open_, jnp.minimum(1.0, BOUNDARY_FRACTION / jnp.maximum(reached.primal, tiny)), 0.0)
    dual = jnp.where(open_, jnp.minimum(1.0, BOUNDARY_FRACTION / jnp.maximum(reached.dual, tiny)), 0.0)
    move = lambda values, steps, length: [v + length * d for v, d in zip(values, steps, strict=True)]
    new = Lanes(
        [x.at[1:].add(step * d) for x, d in zip(it.X, dX, strict=True)],
        move(it.U, dU, step),
        [c + step * (n - c) for c, n in zip(it.costates, costates, strict=True)],
        move(it.slack, d_slack, step),
        move(it.dual, d_dual, dual),
    )
    barrier = _next_barrier(new, barrier, jnp.minimum(step, dual), tolerance)
    return _Loop(new, barrier, kkt, swept.violation, loop.num_steps + 1)


def _next_barrier(new: Lanes, barrier: Array, length: Array, tolerance: Array) -> Array:
    """Follows the mean product of slack and dual down, faster after long steps."""
    if not new.slack:
        return barrier
    products = sum(jnp.sum(s * z, axis=0) for s, z in zip(new.slack, new.dual, strict=True))
    gap = products / (len(new.slack) * new.slack[0].shape[0])
    return jnp.maximum(jnp.clip((1 - length) ** 2, 0.1, 0.8) * gap, 0.1 * tolerance)


def _start(ocp: AbstractLanes, x0: Components, u_before: Components, X: Components, U: Components, barrier) -> Lanes:
    X = [x.at[0].set(first) for x, first in zip(X, x0, strict=True)]
    change = [u - b for u, b in zip(U, _before(U, u_before), strict=True)]
    slack = [jnp.maximum(g, SLACK_FLOOR) for g in _measured(_gaps(ocp), U, change, [x[1:] for x in X])]
    return Lanes(X, U, [jnp.zeros_like(x[1:]) for x in X], slack, [barrier / s for s in slack])


def _result(done: Array, finite: Array) -> RESULTS:
    failed = RESULTS.where(finite, RESULTS.not_converged, RESULTS.non_finite)  # pyright: ignore[reportArgumentType]
    return RESULTS.where(done, RESULTS.successful, failed)  # pyright: ignore[reportArgumentType]


def solve_lanes(
    ocp: AbstractLanes,
    x0: Float[Array, "nx batch"],
    u_before: Float[Array, "nu batch"],
    params: PyTree,
    X: Float[Array, "nx N+1 batch"],
    U: Float[Array, "nu N batch"],
    options: Options,
    needed: Bool[Array, " batch"] | None = None,
) -> LanePlans:
    """Solve a batch from the guess `X`, `U`; leaves of `params` are (N+1, batch) or (N+1, 1), the last row for the end.

    A lane's `result` is `successful` only where its KKT residual and violation are below the tolerance. Lanes that are
    not `needed` stay at their guess and hold up none; the first barrier may be one of each lane (batch,).
    """
    dtype = U[0].dtype
    tolerance, barrier = options.tolerance.astype(dtype), options.barrier.astype(dtype)
    stages, last = split(params)
    lanes, before = _start(ocp, list(x0), list(u_before), list(X), list(U), barrier), list(u_before)
    large = jnp.full_like(U[0][0], jnp.inf)
    loop = _Loop(lanes, jnp.full_like(large, barrier), large, large, jnp.zeros((), jnp.int32))

    needed = jnp.full_like(large, True, bool) if needed is None else needed

    def unfinished(s: _Loop):
        return jnp.any(_open(s.kkt, s.violation, tolerance, needed)) & (s.num_steps < options.max_steps)

    end = jax.lax.while_loop(unfinished, lambda s: _iterate(ocp, stages, last, before, tolerance, needed, s), loop)
    done = jnp.maximum(end.kkt, end.violation) <= tolerance
    finite = jnp.isfinite(end.kkt) & jnp.isfinite(end.violation)
    result = jax.vmap(_result)(done, finite)
    it = end.lanes
    cost = _objective(ocp, it, _before(it.U, before), stages, last)
    dual = jnp.stack(it.dual) if it.dual else jnp.zeros((0, *it.U[0].shape), dtype)
    X, U, costates = (jnp.stack(v) for v in (it.X, it.U, it.costates))
    return LanePlans(X, U, costates, dual, cost, end.kkt, end.violation, end.num_steps, result)


def _objective(ocp: AbstractLanes, it: Lanes, before: Components, stages: PyTree, last: PyTree) -> Array:
    cost = jnp.sum(ocp.cost([x[:-1] for x in it.X], it.U, stages), axis=0) + ocp.terminal([x[-1] for x in it.X], last)
    for u, b, weight in zip(it.U, before, ocp.rate_weight() or [0.0] * len(it.U), strict=True):
        cost = cost + weight * jnp.sum((u - b) ** 2, axis=0)
    return cost
