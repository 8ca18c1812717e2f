"""Derivatives of functions of components, entry by entry, where None is an entry that is zero whatever the values.

A component is an array of any shape; functions act on each element by itself. So batches need no `vmap`, stay on the
last axis, and no work is done for entries that vanish.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax import Array

from driftjax.core.materialise import bind

Entry = Any  # an array, or None for zero
Matrix = list[list[Entry]]

ADD, SUBTRACT = ("add_any", "add"), ("sub",)


def total(terms: Iterable[Entry]) -> Entry:
    """Sum of the terms that are not None."""
    present = [term for term in terms if term is not None]
    return functools.reduce(lambda a, b: a + b, present) if present else None


def times(*factors: Entry) -> Entry:
    """Product; None where a factor is."""
    return None if any(f is None for f in factors) else functools.reduce(lambda a, b: a * b, factors)


def dot(a: Sequence[Entry], b: Sequence[Entry]) -> Entry:
    """Sum of products."""
    return total(times(p, q) for p, q in zip(a, b, strict=True))


def column(A: Matrix, j: int) -> list[Entry]:
    """Entries of one column."""
    return [row[j] for row in A]


def jacobian(function: Callable[..., Sequence[Array]], *z: Array) -> tuple[list[Array], Matrix]:
    """Values of `function(*z)` and their derivatives [output][input]; the function is passed over once."""
    values, push = jax.linearize(lambda *z: list(function(*z)), *z)
    linear = jax.make_jaxpr(push)(*z)
    columns = []
    for i in range(len(z)):
        tangents = [jnp.ones_like(zj) if i == j else None for j, zj in enumerate(z)]
        columns.append(_pushed(linear.jaxpr, linear.consts, tangents))
    return values, [list(row) for row in zip(*columns, strict=True)]


def hessian(function: Callable[..., Array], *z: Array) -> tuple[list[Entry], Matrix]:
    """Gradient and second derivatives of a function of one output; entries below the diagonal are those above."""
    grad = jax.grad(lambda *z: jnp.sum(function(*z)), tuple(range(len(z))))
    gradient, H = jacobian(grad, *z)
    return gradient, [[H[min(i, j)][max(i, j)] for j in range(len(z))] for i in range(len(z))]


def _pushed(jaxpr: Any, consts: Sequence[Array], tangents: Sequence[Entry]) -> list[Entry]:
    """A linear program applied to tangents of which some are zero."""
    known: dict[Any, Entry] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *tangents], strict=True))
    read = lambda v: v.val if isinstance(v, jex.Literal) else known[v]
    for eqn in jaxpr.eqns:
        values, name = [read(v) for v in eqn.invars], eqn.primitive.name
        inner = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
        if inner is not None and name in ("jit", "pjit", "closed_call"):
            out = _pushed(inner.jaxpr, inner.consts, values)
        elif not any(value is None for value in values):
            out = bind(eqn, values)
        elif name in ADD:
            out = [total(values)]
        elif name in SUBTRACT and values[0] is None:
            out = [None if values[1] is None else -values[1]]
        elif name in SUBTRACT:
            out = [values[0]]
        elif name == "select_n" and any(value is not None for value in values[1:]):
            filled = [jnp.zeros(v.aval.shape, v.aval.dtype) if value is None else value
                      for v, value in zip(eqn.invars, values, strict=True)]  # fmt: skip
            out = bind(eqn, filled)
        elif name in ("mul", "div", "neg", "convert_element_type", "broadcast_in_dim", "reduce_sum", "copy",
                      "reshape", "squeeze", "select_n", "transpose", "integer_pow"):  # fmt: skip
            out = [None]
        else:
            raise NotImplementedError(f"no rule for zeros through '{name}'; add it to driftjax/solve/sparse.py")
        known.update(zip(eqn.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


class _Slope(NamedTuple):
    """One stage of a Runge-Kutta step: where it is taken, the slope there, derivatives of both by (x, u)."""

    at: list[Array]
    S: Matrix
    slope: Sequence[Array]
    K: Matrix


def _slopes(
    rates: Callable[..., Sequence[Array]], x: Sequence[Array], u: Sequence[Array], dt: Array | float
) -> list[_Slope]:
    """The four stages of the classical method, each chained to the one before."""
    nx, nz = len(x), len(x) + len(u)
    one = [[jnp.ones_like(x[0]) if i == j else None for j in range(nz)] for i in range(nx)]
    slope, J = jacobian(rates, *x, *u)
    stages = [_Slope(list(x), one, slope, J)]
    for into in (dt / 2, dt / 2, dt):
        before = stages[-1]
        at = [xi + into * s for xi, s in zip(x, before.slope, strict=True)]
        moved = [[times(into, e) for e in row] for row in before.K]
        slope, J = jacobian(rates, *at, *u)
        K = [[total((J[i][j], dot(J[i][:nx], column(moved, j)))) for j in range(nz)] for i in range(nx)]
        S = [[total(pair) for pair in zip(*rows, strict=True)] for rows in zip(one, moved, strict=True)]
        stages.append(_Slope(at, S, slope, K))
    return stages


def runge_kutta(
    rates: Callable[..., Sequence[Array]], x: Sequence[Array], u: Sequence[Array], dt: Array | float
) -> tuple[list[Array], Matrix]:
    """State one step of the classical method of order 4 later, and its derivatives [state][state and input].

    `rates(*x, *u)` are the time derivatives of `x` for inputs `u` held over the step. The derivatives are chained stage
    by stage, which is much less work than to differentiate the step.
    """
    stages = _slopes(rates, x, u, dt)
    ends, M = list(x), stages[0].S
    for stage, weight in zip(stages, (dt / 6, dt / 3, dt / 3, dt / 6), strict=True):
        ends = [e + weight * s for e, s in zip(ends, stage.slope, strict=True)]
        M = [
            [total((m, times(weight, k))) for m, k in zip(*rows, strict=True)] for rows in zip(M, stage.K, strict=True)
        ]
    return ends, M


def runge_kutta_curvature(
    rates: Callable[..., Sequence[Array]], x: Sequence[Array], u: Sequence[Array], dt: Array | float, costate: list
) -> Matrix:
    """Second derivatives of `costate @ state one step later` in (x, u): stage by stage, backwards."""
    nx, nz = len(x), len(x) + len(u)
    H: Matrix = [[None] * nz for _ in range(nz)]
    pull: list[Entry] = [None] * nx
    stages, weights, afters = _slopes(rates, x, u, dt), (dt / 6, dt / 3, dt / 3, dt / 6), (0.0, dt, dt / 2, dt / 2)
    for stage, weight, after in zip(reversed(stages), weights, afters, strict=True):
        nu = [total((weight * c, times(after, p))) for c, p in zip(costate, pull, strict=True)]
        gradient, bend = hessian(lambda *z, nu=nu: dot(nu, rates(*z)), *stage.at, *u)
        pull = gradient[:nx]
        H = _congruence(H, bend, stage.S, nx, nz)
    return H


def _congruence(H: Matrix, bend: Matrix, S: Matrix, nx: int, nz: int) -> Matrix:
    """H + D' bend D with D = [S; 0 I], symmetric."""
    W = [
        [total((dot(bend[p][:nx], column(S, j)), bend[p][j] if j >= nx else None)) for j in range(nz)]
        for p in range(nz)
    ]
    out: Matrix = [[None] * nz for _ in range(nz)]
    for i in range(nz):
        for j in range(i, nz):
            own = dot(column(S, i), [W[p][j] for p in range(nx)])
            out[i][j] = out[j][i] = total((H[i][j], own, W[i][j] if i >= nx else None))
    return out
