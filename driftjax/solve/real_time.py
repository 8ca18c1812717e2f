"""One real-time iteration for a batch: linearise once at a guess and solve the quadratic program."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

from driftjax.solve.interior_point import split
from driftjax.solve.lane_ocp import AbstractLanes, Components, Limits
from driftjax.solve.lanes import LanePlans, solve_lanes
from driftjax.solve.materialise import materialised
from driftjax.solve.ocp import Options
from driftjax.solve.sparse import Entry, Matrix, dot, hessian, times, total


class _Model(NamedTuple):
    """A stage about the guess `z` = (x, u): next state y + M (z - z0), cost h (z - z0) + half its square in H."""

    z: Components
    y: Components
    M: Matrix
    h: list[Entry]
    H: Matrix


class _Quadratic(AbstractLanes):
    """The quadratic program; limits are those of the problem."""

    ocp: AbstractLanes

    def step(self, x: Components, u: Components, p: _Model) -> Components:
        return self.linearise(x, u, p, None)[0]

    def linearise(self, x: Components, u: Components, p: _Model, around: None) -> tuple[Components, Matrix]:
        away = [a - b for a, b in zip((*x, *u), p.z, strict=True)]
        return [jnp.asarray(total((y, dot(row, away)))) for y, row in zip(p.y, p.M, strict=True)], p.M

    def expand(self, x: Components, u: Components, costate: Components, p: _Model, around: None):
        return *self.linearise(x, u, p, None), [[None] * len(p.z) for _ in p.z]

    def cost(self, x: Components, u: Components, p: _Model) -> Array:
        return _square([a - b for a, b in zip((*x, *u), p.z, strict=True)], p.h, p.H)

    def terminal(self, x: Components, p: _Model) -> Array:
        n = len(x)
        return _square([a - b for a, b in zip(x, p.z, strict=False)], p.h[:n], [row[:n] for row in p.H[:n]])

    def rate_weight(self):
        return self.ocp.rate_weight()

    def input_limits(self) -> Limits:
        return self.ocp.input_limits()

    def change_limits(self) -> Limits:
        return self.ocp.change_limits()

    def state_limits(self) -> Limits:
        return self.ocp.state_limits()


def _square(away: Components, h: list[Entry], H: Matrix) -> Array:
    bent = [dot(row, away) for row in H]
    half = [times(0.5 * a, b) for a, b in zip(away, bent, strict=True)]
    return jnp.asarray(total((dot(h, away), *half, jnp.zeros_like(away[0]))))


def _models(ocp: AbstractLanes, X: Components, U: Components, params: PyTree) -> _Model:
    """Return the models of stages 0..N-1, and in row N the expansion of the terminal cost."""
    n, head = len(X), [x[:-1] for x in X]
    stages, last = split(params)
    y, M = ocp.linearise(head, U, stages, ocp.around(head, U, stages))
    h, H = hessian(lambda *z: ocp.cost(list(z[:n]), list(z[n:]), stages), *head, *U)
    hN, HN = hessian(lambda *x: ocp.terminal(list(x), last), *(x[-1] for x in X))
    zero = jnp.zeros_like(U[0][0])
    wide = lambda values: [*values, *[None] * len(U)]
    HN = [*map(wide, HN), *[[None] * (n + len(U)) for _ in U]]

    def join(stage: Entry, end: Entry) -> Entry:
        if stage is None and end is None:
            return None
        stage = jnp.zeros_like(U[0]) if stage is None else stage
        end = zero if end is None else jnp.broadcast_to(end, zero.shape)
        return jnp.concatenate([jnp.broadcast_to(stage, U[0].shape), end[None]])

    pair = lambda a, b: jax.tree.map(join, a, b, is_leaf=lambda e: e is None)
    z = [*X, *(join(u, None) for u in U)]
    nothing = [[None] * len(row) for row in M]
    return _Model(z, pair(y, [None] * n), pair(M, nothing), pair(list(h), wide(hN)), pair(H, HN))


def real_time_iteration(
    ocp: AbstractLanes,
    x0: Float[Array, "nx batch"],
    u_before: Float[Array, "nu batch"],
    params: PyTree,
    X: Float[Array, "nx N+1 batch"],
    U: Float[Array, "nu N batch"],
    options: Options,
) -> LanePlans:
    """Return one SQP step from the guess `X`, `U` (Diehl et al. 2005), Gauss-Newton Hessian.

    The quadratic program is solved to the tolerance in `options`; `kkt`, `violation` and `result` refer to it. Shapes
    are those of `solve_lanes`.
    """
    models = materialised(lambda X, U, p: _models(ocp, X, U, p))(list(X), list(U), params)
    return solve_lanes(_Quadratic(ocp), x0, u_before, models, X, U, options)
