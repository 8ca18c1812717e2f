"""One stage of the Riccati recursion, entry by entry, for costs and limits that depend on the previous input too.

The value of a stage is a quadratic in (x, w), x the state and w the input of the stage before:
half of x'Px + 2 x'Sw + w'Tw, plus p'x + v'w. `factor_stage` treats the matrices, `gradient_stage` one right-hand side.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from driftjax.solve.component_derivatives import Entry, Matrix, column, dot, times, total

TINY = 1e-30  # keeps a matrix of zeros finite
FLOOR = 8.0  # roundings added to the eigenvalues of the input Hessian scaled to unit diagonal [-]


class CostHessian(NamedTuple):
    """Second derivatives of the cost-to-go in the state and the previous input."""

    P: Matrix
    S: Matrix
    T: Matrix


class CostGradient(NamedTuple):
    """First derivatives of the cost-to-go in the state and the previous input."""

    p: list[Entry]
    v: list[Entry]


class StageSystem(NamedTuple):
    """Matrices of the Newton system of one stage; entries None are zero."""

    A: Matrix  # derivatives of the next state
    B: Matrix
    H: Matrix  # in (x, u)
    rate: list[Entry]  # second derivative in the change of each input


class StageTerms(NamedTuple):
    """Right-hand side of the Newton system of one stage; entries None are zero."""

    c: list[Entry]  # defect
    h: list[Entry]  # first derivative in (x, u)
    pull: list[Entry]  # first derivative in the change of each input


class StageFactors(NamedTuple):
    """Factorised stage: gains of the step of the input k + Kx dx + Kw dw, inverse input Hessian, Hessian after it."""

    Kx: Matrix
    Kw: Matrix
    inverse: Matrix
    P: Matrix
    S: Matrix
    convex: Array  # whether the input Hessian is positive definite


def inverse_absolute(Q: Matrix) -> tuple[Matrix, Matrix, Array]:
    """Invert a 1x1 or 2x2 symmetric matrix after replacing its eigenvalues by their absolute values.

    Along a direction of negative curvature the step is then as long as the curvature is weak, not unbounded as it
    would be with a small floor (Dauphin et al. 2014). Returns the inverse, the matrix with absolute eigenvalues less
    the matrix, and whether the matrix is positive definite: then nothing is changed.
    """
    floor = FLOOR * jnp.finfo(Q[0][0].dtype).eps
    scale = [1 / jnp.sqrt(jnp.maximum(jnp.abs(Q[i][i]), 1e-12)) for i in range(len(Q))]
    if len(Q) == 1:
        inverse = scale[0] ** 2 / jnp.maximum(jnp.abs(Q[0][0] * scale[0] ** 2), floor)
        return [[inverse]], [[jnp.abs(Q[0][0]) - Q[0][0]]], Q[0][0] > 0
    a, b, d = Q[0][0] * scale[0] ** 2, Q[0][1] * scale[0] * scale[1], Q[1][1] * scale[1] ** 2
    signed = a * d - b**2
    determinant = jnp.abs(signed)
    size = 1 / jnp.sqrt(jnp.maximum(a**2 + 2 * b**2 + d**2 + 2 * determinant, TINY))
    p, q, r = a**2 + b**2, b * (a + d), d**2 + b**2
    p, q, r = (p + determinant) * size + floor, q * size, (r + determinant) * size + floor
    over = 1 / (p * r - q**2)
    cross = -q * over * scale[0] * scale[1]
    inverse = [[r * over * scale[0] ** 2, cross], [cross, p * over * scale[1] ** 2]]
    convex = (signed > 0) & (a > 0)
    raised = lambda new, old, i, j: jnp.where(convex, 0.0, (new - old) / (scale[i] * scale[j]))
    cross = raised(q, b, 0, 1)
    return inverse, [[raised(p, a, 0, 0), cross], [cross, raised(r, d, 1, 1)]], convex


def _symmetric(n: int, entry) -> Matrix:
    upper = {(i, j): entry(i, j) for i in range(n) for j in range(i, n)}
    return [[upper[min(i, j), max(i, j)] for j in range(n)] for i in range(n)]


def factor_stage(V: CostHessian, s: StageSystem) -> tuple[CostHessian, StageFactors]:
    """Return the Hessian of the cost-to-go before the stage and the factors of it, from the Hessian after."""
    n, m = len(s.A), len(s.rate)
    X, U = range(n), range(m)
    PA = [[dot(V.P[i], column(s.A, j)) for j in X] for i in X]
    PB = [[total((dot(V.P[i], column(s.B, l)), V.S[i][l])) for l in U] for i in X]
    Qux = [[total((dot(column(s.B, l), column(PA, j)), dot(column(V.S, l), column(s.A, j)), s.H[j][n + l])) for j in X]
           for l in U]  # fmt: skip
    Quu = _symmetric(m, lambda i, j: total((
        dot(column(s.B, i), column(PB, j)), dot(column(V.S, i), column(s.B, j)), V.T[i][j], s.H[n + i][n + j],
        s.rate[i] if i == j else None,
    )))  # fmt: skip
    inverse, raised, convex = inverse_absolute(Quu)
    minus = [[-e for e in row] for row in inverse]
    Kx = [[dot(minus[l], column(Qux, j)) for j in X] for l in U]
    Kw = [[times(inverse[l][q], s.rate[q]) for q in U] for l in U]
    negated = [None if r is None else -r for r in s.rate]
    before = CostHessian(
        P=_hessian_along_policy(V, s, raised, Kx),
        S=[[dot(column(Qux, i), column(Kw, l)) for l in U] for i in X],
        T=_symmetric(m, lambda i, j: total((s.rate[i] if i == j else None, times(negated[i], Kw[i][j])))),
    )
    return before, StageFactors(Kx, Kw, inverse, V.P, V.S, convex)


def _hessian_along_policy(V: CostHessian, s: StageSystem, raised: Matrix, Kx: Matrix) -> Matrix:
    """Return the second derivatives in the state under the policy, as a congruence (Joseph's form).

    Large terms of active state limits are multiplied by what the policy leaves of their direction. The shorter form
    Qxx + Qxu Kx subtracts them from each other, and loses as many digits as they are large. `raised` is what makes the
    input Hessian positive definite.
    """
    n, m = len(s.A), len(s.rate)
    X, U = range(n), range(m)
    A = [[total((s.A[i][j], dot(s.B[i], column(Kx, j)))) for j in X] for i in X]  # of the next state under the policy
    by_x = [[total((dot(V.P[i], column(A, j)), dot(V.S[i], column(Kx, j)))) for j in X] for i in X]
    own = lambda a, b: total((V.T[a][b], s.H[n + a][n + b], raised[a][b], s.rate[a] if a == b else None))
    R = [[own(a, b) for b in U] for a in U]
    by_u = [[total((dot(column(V.S, a), column(A, j)), dot(R[a], column(Kx, j)), s.H[n + a][j])) for j in X] for a in U]
    return _symmetric(n, lambda i, j: total((
        s.H[i][j], dot(s.H[i][n:], column(Kx, j)),
        dot(column(A, i), column(by_x, j)), dot(column(Kx, i), column(by_u, j)),
    )))  # fmt: skip


def gradient_stage(
    after: CostGradient, f: StageFactors, s: StageSystem, terms: StageTerms
) -> tuple[CostGradient, list[Entry]]:
    """Return the gradient of the cost-to-go before the stage and the constant part of the step of the input."""
    n, m = len(s.A), len(s.rate)
    g = [total((dot(f.P[i], terms.c), after.p[i])) for i in range(n)]
    qu = [total((dot(column(s.B, l), g), dot(column(f.S, l), terms.c), after.v[l], terms.h[n + l], terms.pull[l]))
          for l in range(m)]  # fmt: skip
    k = [None if e is None else -e for e in (dot(row, qu) for row in f.inverse)]
    p = [total((dot(column(s.A, i), g), terms.h[i], dot(column(f.Kx, i), qu))) for i in range(n)]
    pulled = [None if e is None else -e for e in terms.pull]
    return CostGradient(p, [total((pulled[l], dot(column(f.Kw, l), qu))) for l in range(m)]), k


def forward_stage(
    f: StageFactors, k: list[Entry], s: StageSystem, c: list[Entry], dx: list[Array], dw: list[Array]
) -> tuple[list[Entry], list[Entry]]:
    """Return the steps of the next state and of the input."""
    du = [total((dot(row, dx), dot(Kw, dw), e)) for row, Kw, e in zip(f.Kx, f.Kw, k, strict=True)]
    return [total((dot(a, dx), dot(b, du), e)) for a, b, e in zip(s.A, s.B, c, strict=True)], du
