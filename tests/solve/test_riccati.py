"""The Riccati sweep against a dense KKT solve; the inverse with absolute eigenvalues against eigh."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from driftjax.solve.batch_newton import NewtonSystem, NewtonTerms, solve_backward, solve_forward, substitute
from driftjax.solve.riccati_componentwise import StageSystem, StageTerms, inverse_absolute

N, NX, NU = 6, 4, 2


class Quadratic(NamedTuple):
    """minimise sum 1/2 d'Hd + h'd, d = (dx, du), subject to dx+ = A dx + B du + c and dx_0 = 0."""

    Hxx: Array
    Hux: Array
    Huu: Array
    hx: Array
    hu: Array
    A: Array
    B: Array
    c: Array
    HN: Array
    hN: Array


def random_problem(seed: int) -> Quadratic:
    """A strictly convex problem with random, partly unstable dynamics and defects."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N, NX + NU, NX + NU))
    H = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(NX + NU)
    last = rng.normal(size=(NX, NX))
    h = rng.normal(size=(N, NX + NU))
    arrays = (
        H[:, :NX, :NX], H[:, NX:, :NX], H[:, NX:, NX:], h[:, :NX], h[:, NX:],
        rng.normal(size=(N, NX, NX)), rng.normal(size=(N, NX, NU)), rng.normal(size=(N, NX)),
        last @ last.T, rng.normal(size=NX),
    )  # fmt: skip
    return Quadratic(*(jnp.asarray(a) for a in arrays))


def dense(q: Quadratic):
    """Step and multipliers from the whole KKT matrix; variables dx_0..dx_N, du_0..du_{N-1}."""
    q = jax.tree.map(np.asarray, q)
    n = NX * (N + 1) + NU * N
    H, h = np.zeros((n, n)), np.zeros(n)
    C, d = np.zeros((NX * (N + 1), n)), np.zeros(NX * (N + 1))
    C[:NX, :NX] = np.eye(NX)
    for k in range(N):
        x, u = slice(NX * k, NX * (k + 1)), slice(NX * (N + 1) + NU * k, NX * (N + 1) + NU * (k + 1))
        H[x, x], H[u, x], H[x, u], H[u, u] = q.Hxx[k], q.Hux[k], q.Hux[k].T, q.Huu[k]
        h[x], h[u] = q.hx[k], q.hu[k]
        row, after = slice(NX * (k + 1), NX * (k + 2)), slice(NX * (k + 1), NX * (k + 2))
        C[row, x], C[row, u], C[row, after] = q.A[k], q.B[k], -np.eye(NX)
        d[row] = -q.c[k]
    end = slice(NX * N, NX * (N + 1))
    H[end, end], h[end] = q.HN, q.hN
    K = np.block([[H, C.T], [C, np.zeros((len(d), len(d)))]])
    z = np.linalg.solve(K, np.concatenate([-h, d]))
    dX, dU = z[: NX * (N + 1)].reshape(N + 1, NX), z[NX * (N + 1) : n].reshape(N, NU)
    return dX, dU, z[n + NX :].reshape(N, NX)


def by_component(q: Quadratic) -> tuple[NewtonSystem, NewtonTerms]:
    """The problem in components, as a batch of one without cost of input changes."""
    H = jnp.concatenate([jnp.concatenate([q.Hxx, q.Hux.mT], axis=2), jnp.concatenate([q.Hux, q.Huu], axis=2)], axis=1)
    rows = lambda a: [[a[:, i, j, None] for j in range(a.shape[2])] for i in range(a.shape[1])]
    column = lambda a: [a[:, i, None] for i in range(a.shape[1])]
    zero = jnp.zeros((N, 1))
    system = StageSystem(rows(q.A), rows(q.B), rows(H), [zero] * NU)
    terms = StageTerms(column(q.c), column(jnp.concatenate([q.hx, q.hu], axis=1)), [zero] * NU)
    end = [[q.HN[i, j, None] for j in range(NX)] for i in range(NX)]
    return NewtonSystem(system, [zero] * NX, end), NewtonTerms(terms, [zero] * NX, [q.hN[i, None] for i in range(NX)])


@jax.jit
def direction(system: NewtonSystem, terms: NewtonTerms):
    """Step of later states and inputs, costates, whether the minimum is strict, and the policy solved for again."""
    factors, policy = solve_backward(system, terms)
    none = [jnp.zeros(1)]
    steps = solve_forward(system, factors, policy, (NX * none, NU * none))
    stack = lambda entries: jnp.stack(entries, axis=1)[..., 0]
    return tuple(map(stack, steps)), jnp.all(factors.convex), policy, substitute(system, factors, terms)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_direction_solves_the_dense_kkt_system(seed):
    q = random_problem(seed)
    steps, strict, policy, again = direction(*by_component(q))
    X, U, costates = dense(q)
    assert bool(strict)
    for step, exact in zip(steps, (X[1:], U, costates), strict=True):
        np.testing.assert_allclose(step, exact, rtol=0, atol=1e-9 * np.abs(exact).max())
    for one, other in zip(jax.tree.leaves(policy), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)


def test_a_point_that_is_no_minimum_is_reported():
    q = random_problem(0)
    assert not bool(direction(*by_component(q._replace(Huu=q.Huu - 1e3 * jnp.eye(NU))))[1])


def absolute(R: np.ndarray) -> np.ndarray:
    """Inverse with the eigenvalues of the matrix, scaled to unit diagonal, made positive, by eigh."""
    scale = 1 / np.sqrt(np.abs(np.diag(R)))
    values, vectors = np.linalg.eigh(R * np.outer(scale, scale))
    return (vectors / np.abs(values)) @ vectors.T * np.outer(scale, scale)


MATRICES = [
    [[2.0, 0.3], [0.3, 1.0]],
    [[2.0, 0.3], [0.3, -1.0]],
    [[-2.0, 0.9], [0.9, -1.0]],
    [[1.0, 5.0], [5.0, 2.0]],
    [[1e6, 10.0], [10.0, 1e-3]],
]


def inverted(R: np.ndarray) -> np.ndarray:
    """The inverse with absolute eigenvalues as a matrix."""
    entries = [[jnp.asarray(value) for value in row] for row in np.asarray(R)]
    return np.array([[float(e) for e in row] for row in inverse_absolute(entries)[0]])


@pytest.mark.parametrize("R", MATRICES)
def test_the_inverse_has_absolute_eigenvalues(R):
    R = np.asarray(R)
    inverse = inverted(R)
    np.testing.assert_allclose(inverse, absolute(R), rtol=1e-6, atol=1e-12)
    assert np.all(np.linalg.eigvalsh(inverse) > 0)


def test_a_positive_matrix_is_simply_inverted():
    R = np.array([[3.0, 0.7], [0.7, 0.5]])
    np.testing.assert_allclose(inverted(R), np.linalg.inv(R), rtol=1e-7)


@pytest.mark.parametrize("value", [4.0, -4.0])
def test_one_input_divides_by_the_magnitude(value):
    np.testing.assert_allclose(inverted(np.array([[value]])), [[0.25]], rtol=1e-7)


def test_a_singular_matrix_stays_finite():
    assert np.all(np.isfinite(inverted(np.ones((2, 2)))))
