"""Derivatives of functions of components, entry by entry; None marks an entry that is structurally zero.

A component is an array of any shape; functions act on each element by itself. So batches need no `vmap`, stay on the
last axis, and no work is done for entries that vanish.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax import Array

from driftjax.core.integrate import RK4
from driftjax.solve.compute_once import bind, compute_once

Entry = Any  # an array, or None for zero
Matrix = list[list[Entry]]

ADD, SUBTRACT = ("add_any", "add"), ("sub",)


def total(terms: Iterable[Entry]) -> Entry:
    """Return the sum of the terms that are not None."""
    present = [term for term in terms if term is not None]
    return functools.reduce(lambda a, b: a + b, present) if present else None


def times(*factors: Entry) -> Entry:
    """Return the product; None if a factor is None."""
    return None if any(f is None for f in factors) else functools.reduce(lambda a, b: a * b, factors)


def dot(a: Sequence[Entry], b: Sequence[Entry]) -> Entry:
    """Return the sum of products."""
    return total(times(p, q) for p, q in zip(a, b, strict=True))


def column(A: Matrix, j: int) -> list[Entry]:
    """Return the entries of one column."""
    return [row[j] for row in A]


Jacobian = Callable[..., tuple[list[Array], Matrix]]  # `jacobian` or `jacobian_together`


def jacobian_together(function: Callable[..., Sequence[Array]], *z: Array) -> tuple[list[Array], Matrix]:
    """Return what `jacobian` returns, with all tangents pushed through the function at once, on an axis of their own.

    The program is as long as the function, not as long as function times inputs, so that long functions trace and
    compile in a fraction of the time; entries that vanish are computed. Takes any primitive.
    """
    values, push = jax.linearize(lambda *z: list(function(*z)), *z)
    depends = _dependence(jax.make_jaxpr(push)(*z).jaxpr)
    one = jnp.eye(len(z), dtype=z[0].dtype)
    tangents = [jnp.broadcast_to(one[i].reshape(-1, *[1] * a.ndim), (len(z), *a.shape)) for i, a in enumerate(z)]
    columns = jax.vmap(push)(*tangents)
    return values, [[c[j] if j in on else None for j in range(len(z))] for c, on in zip(columns, depends, strict=True)]


def _dependence(jaxpr: Any) -> list[set[int]]:
    """Return the numbers of the inputs on which each output of a linear program depends."""
    known: dict[Any, set[int]] = {v: set() for v in jaxpr.constvars} | {v: {i} for i, v in enumerate(jaxpr.invars)}
    read = lambda v: set() if isinstance(v, jex.Literal) else known[v]
    for eqn in jaxpr.eqns:
        known.update(dict.fromkeys(eqn.outvars, set().union(*map(read, eqn.invars))))
    return [read(v) for v in jaxpr.outvars]


def jacobian(function: Callable[..., Sequence[Array]], *z: Array) -> tuple[list[Array], Matrix]:
    """Return the values of `function(*z)` and their derivatives [output][input], in one pass over the function.

    Entry by entry: least work in large batches.
    """
    values, push = jax.linearize(lambda *z: list(function(*z)), *z)
    linear = jax.make_jaxpr(push)(*z)
    columns = []
    for i in range(len(z)):
        tangents = [jnp.ones_like(zj) if i == j else None for j, zj in enumerate(z)]
        columns.append(_push_tangents(linear.jaxpr, linear.consts, tangents))
    return values, [list(row) for row in zip(*columns, strict=True)]


def hessian(function: Callable[..., Array], *z: Array, jacobian: Jacobian = jacobian) -> tuple[list[Entry], Matrix]:
    """Return gradient and second derivatives of a function of one output; symmetric entries are shared."""
    grad = jax.grad(lambda *z: jnp.sum(function(*z)), tuple(range(len(z))))
    gradient, H = jacobian(grad, *z)
    return gradient, [[H[min(i, j)][max(i, j)] for j in range(len(z))] for i in range(len(z))]


def _push_tangents(jaxpr: Any, consts: Sequence[Array], tangents: Sequence[Entry]) -> list[Entry]:
    """Apply a linear program to tangents, some of which are zero."""
    known: dict[Any, Entry] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *tangents], strict=True))
    read = lambda v: v.val if isinstance(v, jex.Literal) else known[v]
    for eqn in jaxpr.eqns:
        values, name = [read(v) for v in eqn.invars], eqn.primitive.name
        inner = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr")
        if inner is not None and name in ("jit", "pjit", "closed_call"):
            out = _push_tangents(inner.jaxpr, inner.consts, values)
        elif name == "div" and values[0] is not None:
            out = [values[0] * (1 / values[1])]  # one division for all the tangents that are divided by this
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
            raise NotImplementedError(
                f"no rule for zeros through '{name}'; add it to driftjax/solve/component_derivatives.py"
            )
        known.update(zip(eqn.outvars, out, strict=True))
    return [read(v) for v in jaxpr.outvars]


def runge_kutta(
    rates: Callable[..., Sequence[Array]],
    x: Sequence[Array],
    u: Sequence[Array],
    dt: Array | float,
    jacobian: Jacobian = jacobian,
) -> tuple[list[Array], Matrix]:
    """Return the state after one step of the classical method of order 4, and its derivatives in x and u.

    `rates(*x, *u)` are the time derivatives of `x` for inputs `u` held over the step. The derivatives are chained slope
    by slope, in a loop: much less work than to differentiate the step, and a program of a quarter of its size.
    """
    nx, nz, zero = len(x), len(x) + len(u), jnp.zeros_like(x[0])
    shape = _shape_of_slopes(rates, x, u, jacobian)

    def chained(carry: tuple, share: tuple[Array, Array]) -> tuple[tuple, None]:
        slope, K, ends, M = carry
        into, weight = (dt * s.astype(zero.dtype) for s in share)
        at = [xi + into * s for xi, s in zip(x, slope, strict=True)]
        S = [[total((times(into, K[i][j]), zero + 1 if i == j else None)) for j in range(nz)] for i in range(nx)]
        slope, J = jacobian(rates, *at, *u)
        K = _filled(_chain(J, S, nx), shape, zero)
        ends = [e + weight * s for e, s in zip(ends, slope, strict=True)]
        M = [[total((m, times(weight, k))) for m, k in zip(*rows, strict=True)] for rows in zip(M, K, strict=True)]
        return (list(slope), K, ends, M), None

    none = _filled([[None] * nz for _ in range(nx)], shape, zero)
    begin = [[total((none[i][j], zero + 1 if i == j else None)) for j in range(nz)] for i in range(nx)]
    carry, tableau = ([zero] * nx, none, list(x), begin), (jnp.asarray(RK4.into), jnp.asarray(RK4.weights))
    (_, _, ends, M), _ = jax.lax.scan(compute_once(chained), carry, tableau)
    return ends, M


def runge_kutta_curvature(
    rates: Callable[..., Sequence[Array]],
    x: Sequence[Array],
    u: Sequence[Array],
    dt: Array | float,
    costate: Sequence[Array],
    jacobian: Jacobian = jacobian,
) -> Matrix:
    """Return the second derivatives in (x, u) of `costate @ next state` of the step of `runge_kutta`, exactly.

    The slopes' Hessians, each weighed by how the next state depends on that slope, are carried to (x, u) by the
    derivatives of the point of evaluation.
    """
    nx, nz, zero = len(x), len(x) + len(u), jnp.zeros_like(x[0])
    shape = _shape_of_slopes(rates, x, u, jacobian)
    none = _filled([[None] * nz for _ in range(nx)], shape, zero)

    def ahead(carry: tuple, into: Array) -> tuple[tuple, tuple]:
        slope, K = carry
        into = dt * into.astype(zero.dtype)
        at = [xi + into * s for xi, s in zip(x, slope, strict=True)]
        S = [[total((times(into, K[i][j]), zero + 1 if i == j else None)) for j in range(nz)] for i in range(nx)]
        slope, J = jacobian(rates, *at, *u)
        pull = [[times(into, e) for e in row[:nx]] for row in J]
        return (list(slope), _filled(_chain(J, S, nx), shape, zero)), (at, S, pull)

    def back(carry: tuple, s: tuple) -> tuple[tuple, None]:
        (after, H), (weight, at, S, pull) = carry, s
        nu = [dt * weight.astype(zero.dtype) * c + a for c, a in zip(costate, after, strict=True)]
        bend = _congruence(hessian(lambda *z: dot(nu, rates(*z)), *at, *u, jacobian=jacobian)[1], S, nx, nz)
        H = [[total((H[i][j], bend[i][i + j])) for j in range(nz - i)] for i in range(nz)]
        return ([total((zero, dot(nu, column(pull, i)))) for i in range(nx)], H), None

    points = jax.lax.scan(compute_once(ahead), ([zero] * nx, none), jnp.asarray(RK4.into))[1]
    upper = [[zero] * (nz - i) for i in range(nz)]
    steps = (jnp.asarray(RK4.weights), *points)
    (_, H), _ = jax.lax.scan(compute_once(back), ([zero] * nx, upper), steps, reverse=True)
    return [[H[min(i, j)][abs(i - j)] for j in range(nz)] for i in range(nz)]


def _chain(J: Matrix, S: Matrix, nx: int) -> Matrix:
    """Return the derivatives of a slope by (x, u) from those by (evaluation point, u)."""
    direct = lambda i, j: J[i][j] if j >= nx else None
    return [[total((direct(i, j), dot(J[i][:nx], column(S, j)))) for j in range(len(J[0]))] for i in range(nx)]


def _filled(M: Matrix, shape: list[list[bool]], zero: Array) -> Matrix:
    """Replace None by zeros where `shape` has an entry, so that a loop carry keeps its structure."""
    return [[zero if e is None and there else e for e, there in zip(*rows, strict=True)]
            for rows in zip(M, shape, strict=True)]  # fmt: skip


def _present(M: Matrix) -> list[list[bool]]:
    return [[e is not None for e in row] for row in M]


def _shape_of_slopes(
    rates: Callable[..., Sequence[Array]], x: Sequence[Array], u: Sequence[Array], jacobian: Jacobian
) -> list[list[bool]]:
    """Return which derivatives of the slopes by (x, u) can differ from zero."""
    nx = len(x)
    J = jax.eval_shape(lambda x, u: jacobian(rates, *x, *u)[1], list(x), list(u))
    some = lambda M: [[1.0 if there else None for there in row] for row in _present(M)]
    reach: Matrix = some(J)
    for _ in range(nx):
        S = [[1.0 if i == j else e for j, e in enumerate(row)] for i, row in enumerate(reach)]
        reach = some(_chain(some(J), S, nx))
    return _present(reach)


def midpoint_curvature(
    rates: Callable[..., Sequence[Array]],
    x: Sequence[Array],
    u: Sequence[Array],
    step: tuple[Sequence[Array], Matrix],
    dt: Array | float,
    costate: Sequence[Array],
    jacobian: Jacobian = jacobian,
) -> Matrix:
    """Return the second derivatives of `costate @ next state` in (x, u), to second order in dt.

    Those of the rates in the middle of the step: state, its derivatives and costate there are the means of both ends.
    `step` is what `runge_kutta` returned.
    """
    (y, M), nx = step, len(x)
    nz, one = nx + len(u), jnp.ones_like(x[0])
    mean = lambda a, b: times(0.5, total((a, b)))
    at = [mean(a, b) for a, b in zip(x, y, strict=True)]
    S = [[mean(M[i][j], one if i == j else None) for j in range(nz)] for i in range(nx)]
    nu = [dt * mean(c, dot(column(M, i), costate)) for i, c in enumerate(costate)]
    return _congruence(hessian(lambda *z: dot(nu, rates(*z)), *at, *u, jacobian=jacobian)[1], S, nx, nz)


def _congruence(bend: Matrix, S: Matrix, nx: int, nz: int) -> Matrix:
    """Return D' bend D with D = [S; 0 I], symmetric."""
    W = [
        [total((dot(bend[p][:nx], column(S, j)), bend[p][j] if j >= nx else None)) for j in range(nz)]
        for p in range(nz)
    ]
    out: Matrix = [[None] * nz for _ in range(nz)]
    for i in range(nz):
        for j in range(i, nz):
            out[i][j] = out[j][i] = total(
                (dot(column(S, i), [W[p][j] for p in range(nx)]), W[i][j] if i >= nx else None)
            )
    return out
