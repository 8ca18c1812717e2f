"""One stage of the Riccati recursion, entry by entry, for costs and limits that depend on the previous input too.

The value of a stage is a quadratic in (x, w), x the state and w the input of the stage before:
half of x'Px + 2 x'Sw + w'Tw, plus p'x + v'w.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from driftjax.solve.component_derivatives import Entry, Matrix, column, dot, times, total
from driftjax.solve.riccati import EIGENVALUE_FLOOR, TINY


class CostToGo(NamedTuple):
    """Cost-to-go, a quadratic in the state and the previous input."""

    P: Matrix
    S: Matrix
    T: Matrix
    p: list[Entry]
    v: list[Entry]


class Policy(NamedTuple):
    """Affine policy for the step of the input: k + Kx dx + Kw dw."""

    Kx: Matrix
    Kw: Matrix
    k: list[Entry]


class StageSystem(NamedTuple):
    """Newton system of one stage; entries None are zero."""

    A: Matrix  # derivatives of the next state
    B: Matrix
    c: list[Entry]  # defect
    H: Matrix  # in (x, u)
    h: list[Entry]
    rate: list[Entry]  # second derivative in the change of each input
    pull: list[Entry]  # first derivative in it


def inverse_absolute_entries(Q: Matrix) -> Matrix:
    """Invert a 1x1 or 2x2 symmetric matrix with absolute eigenvalues; as `riccati.inverse_absolute`."""
    scale = [1 / jnp.sqrt(jnp.maximum(jnp.abs(Q[i][i]), 1e-12)) for i in range(len(Q))]
    if len(Q) == 1:
        return [[scale[0] ** 2 / jnp.maximum(jnp.abs(Q[0][0] * scale[0] ** 2), EIGENVALUE_FLOOR)]]
    a, b, d = Q[0][0] * scale[0] ** 2, Q[0][1] * scale[0] * scale[1], Q[1][1] * scale[1] ** 2
    determinant = jnp.abs(a * d - b**2)
    size = 1 / jnp.sqrt(jnp.maximum(a**2 + 2 * b**2 + d**2 + 2 * determinant, TINY))
    p, q, r = a**2 + b**2, b * (a + d), d**2 + b**2
    p, q, r = (p + determinant) * size + EIGENVALUE_FLOOR, q * size, (r + determinant) * size + EIGENVALUE_FLOOR
    over = 1 / (p * r - q**2)
    cross = -q * over * scale[0] * scale[1]
    return [[r * over * scale[0] ** 2, cross], [cross, p * over * scale[1] ** 2]]


def _symmetric(n: int, entry) -> Matrix:
    upper = {(i, j): entry(i, j) for i in range(n) for j in range(i, n)}
    return [[upper[min(i, j), max(i, j)] for j in range(n)] for i in range(n)]


def backward_stage(V: CostToGo, s: StageSystem) -> tuple[CostToGo, Policy]:
    """Return cost-to-go before the stage and the policy in it, from the cost-to-go after."""
    n, m = len(s.A), len(s.rate)
    X, U = range(n), range(m)
    PA = [[dot(V.P[i], column(s.A, j)) for j in X] for i in X]
    PB = [[total((dot(V.P[i], column(s.B, l)), V.S[i][l])) for l in U] for i in X]
    g = [total((dot(V.P[i], s.c), V.p[i])) for i in X]
    Qxx = _symmetric(n, lambda i, j: total((dot(column(s.A, i), column(PA, j)), s.H[i][j])))
    Qux = [[total((dot(column(s.B, l), column(PA, j)), dot(column(V.S, l), column(s.A, j)), s.H[j][n + l])) for j in X]
           for l in U]  # fmt: skip
    Quu = _symmetric(m, lambda i, j: total((
        dot(column(s.B, i), column(PB, j)), dot(column(V.S, i), column(s.B, j)), V.T[i][j], s.H[n + i][n + j],
        s.rate[i] if i == j else None,
    )))  # fmt: skip
    qx = [total((dot(column(s.A, i), g), s.h[i])) for i in X]
    qu = [total((dot(column(s.B, l), g), dot(column(V.S, l), s.c), V.v[l], s.h[n + l], s.pull[l])) for l in U]
    inverse = inverse_absolute_entries(Quu)
    minus = [[-e for e in row] for row in inverse]
    Kx = [[dot(minus[l], column(Qux, j)) for j in X] for l in U]
    Kw = [[times(inverse[l][q], s.rate[q]) for q in U] for l in U]
    k = [dot(minus[l], qu) for l in U]
    negated = [None if r is None else -r for r in s.rate]
    before = CostToGo(
        P=_symmetric(n, lambda i, j: total((Qxx[i][j], dot(column(Qux, i), column(Kx, j))))),
        S=[[dot(column(Qux, i), column(Kw, l)) for l in U] for i in X],
        T=_symmetric(m, lambda i, j: total((s.rate[i] if i == j else None, times(negated[i], Kw[i][j])))),
        p=[total((qx[i], dot(column(Qux, i), k))) for i in X],
        v=[total((None if s.pull[l] is None else -s.pull[l], times(negated[l], k[l]))) for l in U],
    )
    return before, Policy(Kx, Kw, k)


def forward_stage(policy: Policy, s: StageSystem, dx: list[Array], dw: list[Array]) -> tuple[list[Entry], list[Entry]]:
    """Return the steps of the next state and of the input."""
    du = [total((dot(row, dx), dot(Kw, dw), k)) for row, Kw, k in zip(policy.Kx, policy.Kw, policy.k, strict=True)]
    return [total((dot(a, dx), dot(b, du), c)) for a, b, c in zip(s.A, s.B, s.c, strict=True)], du
