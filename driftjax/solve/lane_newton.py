"""Newton's system of a batch of barrier problems: set up for all stages at once, solved by one Riccati sweep."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PyTree

from driftjax.solve.interior_point import BOUNDARY_FRACTION
from driftjax.solve.lane_ocp import AbstractLanes, Components
from driftjax.solve.materialise import materialised
from driftjax.solve.sparse import Entry, Matrix, column, dot, hessian, total
from driftjax.solve.stage import Local, Policy, Value, backward, forward

Held = Callable[[str, int], list[Array]]  # what the limits of an entry of a family contribute


class Lanes(NamedTuple):
    """Iterate: components (stages, batch); slacks and duals of each limit in the order of `gaps_of`."""

    X: Components  # (N+1, batch)
    U: Components  # (N, batch)
    costates: Components  # (N, batch), of the dynamics into x_1..x_N
    slack: Components  # (N, batch)
    dual: Components


class Gap(NamedTuple):
    """sign (y - bound) >= 0 for an entry of a family of variables."""

    family: str
    entry: int
    sign: float
    bound: Array | float


def gaps_of(ocp: AbstractLanes) -> list[Gap]:
    """Return the limits that exist: of inputs, their changes, states."""
    families = (("input", ocp.input_limits()), ("change", ocp.change_limits()), ("state", ocp.state_limits()))
    return [
        Gap(family, i, sign, bound)
        for family, limits in families
        for i, pair in enumerate(limits)
        for sign, bound in zip((1.0, -1.0), pair, strict=True)
        if bound is not None
    ]


def measured(gaps: list[Gap], u: Components, change: Components, x_next: Components) -> Components:
    """Return the values of the gaps, positive within the limits."""
    of = {"input": u, "change": change, "state": x_next}
    return [gap.sign * (of[gap.family][gap.entry] - gap.bound) for gap in gaps]


def inputs_before(U: Components, u_before: Components) -> Components:
    """Return the input before each stage (N, batch); `u_before` (batch,) is the one before the first."""
    return [jnp.concatenate([b[None], u[:-1]]) for u, b in zip(U, u_before, strict=True)]


class Newton(NamedTuple):
    """Newton system of the barrier problem; entries (N, batch) or None for zero."""

    local: Local
    stiff: list[Entry]  # second derivatives of the limits of the state after, which belong to its value
    pull: list[Entry]  # first derivatives of them
    end: tuple[list[Entry], Matrix]  # derivatives of the terminal cost (batch,)
    misfit: Components  # gap less slack of each limit


class Error(NamedTuple):
    """How far an iterate is from optimal."""

    kkt: Array  # scaled stationarity and complementarity
    violation: Array  # worst defect or violation of a limit


def _filled(entries: Any, like: Array) -> Any:
    """Replace None by zeros."""
    return jax.tree.map(lambda e: jnp.zeros_like(like) if e is None else e, entries, is_leaf=lambda e: e is None)


def newton_system(
    ocp: AbstractLanes, stages: PyTree, last: PyTree, u_before: Components, it: Lanes, barrier: Array
) -> tuple[Newton, Error]:
    """Return the Newton system at an iterate, and its error; parameters of stages 0..N-1 and of the end."""
    gaps, nx, nu = gaps_of(ocp), len(it.X), len(it.U)
    x, after = [x[:-1] for x in it.X], [x[1:] for x in it.X]
    change = [a - b for a, b in zip(it.U, inputs_before(it.U, u_before), strict=True)]
    g = measured(gaps, it.U, change, after)
    y, M, bend = ocp.expand(x, it.U, it.costates, stages, ocp.around(x, it.U, stages))
    h, H = hessian(lambda *z: ocp.cost(list(z[:nx]), list(z[nx:]), stages), *x, *it.U)
    weight = ocp.rate_weight() or [0.0] * nu
    inv = [1 / slack for slack in it.slack]
    stiff = [z * i for z, i in zip(it.dual, inv, strict=True)]
    pull = [w * (gap - slack) - barrier * i for w, gap, slack, i in zip(stiff, g, it.slack, inv, strict=True)]
    of = lambda family, entry, values: [
        v for gap, v in zip(gaps, values, strict=True) if (gap.family, gap.entry) == (family, entry)
    ]
    signed = lambda values: [gap.sign * v for gap, v in zip(gaps, values, strict=True)]
    moved = [2 * weight[l] * change[l] for l in range(nu)]
    H = [[total((H[i][j], bend[i][j], *(of("input", i - nx, stiff) if i == j >= nx else ())))
          for j in range(nx + nu)] for i in range(nx + nu)]  # fmt: skip
    defect, towards = [a - b for a, b in zip(y, after, strict=True)], signed(pull)
    local = Local(
        A=[row[:nx] for row in M],
        B=[row[nx:] for row in M],
        c=defect,
        H=H,
        h=[total((h[i], *(of("input", i - nx, towards) if i >= nx else ()))) for i in range(nx + nu)],
        rate=[total((2 * weight[l] + jnp.zeros_like(moved[l]), *of("change", l, stiff))) for l in range(nu)],
        pull=[total((moved[l], *of("change", l, towards))) for l in range(nu)],
    )
    states = [total(of("state", i, stiff)) for i in range(nx)], [total(of("state", i, towards)) for i in range(nx)]
    end = hessian(lambda *x: ocp.terminal(list(x), last), *(x[-1] for x in it.X))
    misfit = [gap - slack for gap, slack in zip(g, it.slack, strict=True)]
    held = [-e for e in signed(it.dual)]
    slope = [total((h[i], dot(column(M, i), it.costates))) for i in range(nx + nu)]  # of cost and dynamics
    unbalanced = _stationarity(slope, end[0], moved, it, lambda family, i: of(family, i, held))
    return Newton(local, *states, end, misfit), _error(it, unbalanced, [*defect, *misfit])


def _error(it: Lanes, unbalanced: Components, violated: Components) -> Error:
    """Return the stationarity scaled by the size of the multipliers (Waechter and Biegler 2006, Eq. 5)."""
    products = [slack * z for slack, z in zip(it.slack, it.dual, strict=True)]
    size = sum(jnp.sum(jnp.abs(v), axis=0) for v in (*it.costates, *it.dual))
    num = it.costates[0].shape[0] * (len(it.X) + len(it.dual))
    return Error(_worst([*unbalanced, *products]) / jnp.maximum(1.0, size / num / 100), _worst(violated))


def _stationarity(slope: list[Entry], end: list[Entry], moved: Components, it: Lanes, held: Held) -> Components:
    """Return the derivatives of the Lagrangian in each later state, in the last state, and in each input."""
    nx = len(it.X)
    slope = _filled(slope, it.U[0])
    own = [total((-it.costates[i], *held("state", i))) for i in range(nx)]
    rx = [slope[i][1:] + own[i][:-1] for i in range(nx)]
    rN = [total((own[i][-1], end[i]))[None] for i in range(nx)]
    rw = [total((moved[l], *held("change", l))) for l in range(len(moved))]
    ru = [total((slope[nx + l], *held("input", l), w)) for l, w in enumerate(rw)]
    return [*rx, *rN, *(u[:-1] - w[1:] for u, w in zip(ru, rw, strict=True)), *(u[-1:] for u in ru)]


def _worst(values: Sequence[Array]) -> Array:
    """Return the largest magnitude over stages and entries."""
    return functools.reduce(jnp.maximum, [jnp.max(jnp.abs(v), axis=0, initial=0.0) for v in values])


class Direction(NamedTuple):
    """Newton step, (N, batch); costates are those it leads to."""

    dX: Components
    dU: Components
    costates: Components
    d_slack: Components
    d_dual: Components


def newton_step(ocp: AbstractLanes, it: Lanes, newton: Newton, barrier: Array) -> Direction:
    """Solve the Newton system: backwards for value and policy, forwards for the step."""
    nx, nu, zero = len(it.X), len(it.U), jnp.zeros_like(barrier)
    wide = lambda entries: jax.tree.map(lambda e: jnp.broadcast_to(e, it.U[0].shape), entries)

    def back(value: Value, s: tuple[Local, list[Entry], list[Entry]]):
        local, stiff, pull = s
        P = [[total((value.P[i][j], stiff[i] if i == j else None)) for j in range(nx)] for i in range(nx)]
        after = value._replace(P=P, p=[total(pair) for pair in zip(value.p, pull, strict=True)])
        value, policy = backward(after, local)
        return _filled(value, zero), _filled((policy, (after.p, after.P, after.S)), zero)

    def forth(carry: tuple[Components, Components], s):
        policy, local, (p, P, S) = s
        dx, du = forward(Policy(*policy), local, *carry)
        costate = [total((p[i], dot(P[i], dx), dot(S[i], du))) for i in range(nx)]
        return (dx, du), (dx, du, costate)

    gradient, P = _filled(newton.end, zero)
    blank = lambda n: [[zero] * nu for _ in range(n)]
    begin = Value(
        [[e + zero for e in row] for row in P], blank(nx), blank(nu), [e + zero for e in gradient], [zero] * nu
    )
    local = wide(newton.local)
    ahead = jax.lax.scan(materialised(back), begin, (local, wide(newton.stiff), wide(newton.pull)), reverse=True)[1]
    dX, dU, costates = jax.lax.scan(materialised(forth), ([zero] * nx, [zero] * nu), (ahead[0], local, ahead[1]))[1]
    of = {"input": dU, "change": [d - b for d, b in zip(dU, inputs_before(dU, [zero] * nu), strict=True)], "state": dX}
    move = [gap.sign * of[gap.family][gap.entry] for gap in gaps_of(ocp)]
    d_slack = [d + r for d, r in zip(move, newton.misfit, strict=True)]
    d_dual = [(barrier - z * ds) / s - z for s, z, ds in zip(it.slack, it.dual, d_slack, strict=True)]
    return Direction(dX, dU, costates, d_slack, d_dual)


def longest(values: Components, steps: Components, open_: Array) -> Array:
    """Return the step length at the fraction-to-boundary rule; 0 for solved entries."""
    if not values:
        return jnp.where(open_, 1.0, 0.0)
    rate = functools.reduce(jnp.maximum, [-d / v for v, d in zip(values, steps, strict=True)])
    return jnp.where(open_, jnp.minimum(1.0, BOUNDARY_FRACTION / jnp.maximum(jnp.max(rate, axis=0), 1e-12)), 0.0)
