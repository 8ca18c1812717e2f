"""The Riccati sweep against a dense KKT solve; the inverse with absolute eigenvalues against eigh."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.solve.riccati import Quadratic, inverse_absolute, newton_direction

N, NX, NU = 6, 4, 2


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


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_direction_solves_the_dense_kkt_system(seed):
    q = random_problem(seed)
    direction = newton_direction(q)
    dX, dU, costates = dense(q)
    # the floor on the scaled eigenvalues of the input blocks, 1e-8, bounds the agreement
    np.testing.assert_allclose(direction.dX, dX, rtol=0, atol=1e-5 * np.abs(dX).max())
    np.testing.assert_allclose(direction.dU, dU, rtol=0, atol=1e-5 * np.abs(dU).max())
    np.testing.assert_allclose(direction.costates, costates, rtol=0, atol=1e-5 * np.abs(costates).max())


def test_the_policy_reproduces_the_direction():
    direction = newton_direction(random_problem(3))
    du = direction.k + jnp.einsum("kij,kj->ki", direction.K, direction.dX[:-1])
    np.testing.assert_allclose(du, direction.dU, rtol=1e-12, atol=1e-12)


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


@pytest.mark.parametrize("R", MATRICES)
def test_the_inverse_has_absolute_eigenvalues(R):
    R = np.asarray(R)
    inverse = np.asarray(jax.jit(inverse_absolute)(jnp.asarray(R)))
    np.testing.assert_allclose(inverse, absolute(R), rtol=1e-6, atol=1e-12)
    assert np.all(np.linalg.eigvalsh(inverse) > 0)


def test_a_positive_matrix_is_simply_inverted():
    R = np.array([[3.0, 0.7], [0.7, 0.5]])
    np.testing.assert_allclose(inverse_absolute(jnp.asarray(R)), np.linalg.inv(R), rtol=1e-7)


@pytest.mark.parametrize("value", [4.0, -4.0])
def test_one_input_divides_by_the_magnitude(value):
    np.testing.assert_allclose(inverse_absolute(jnp.asarray([[value]])), [[0.25]], rtol=1e-7)


def test_a_singular_matrix_stays_finite():
    assert bool(jnp.all(jnp.isfinite(inverse_absolute(jnp.ones((2, 2))))))
