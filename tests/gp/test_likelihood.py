"""The closed-form derivatives of the likelihood against autodiff of its value and against dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.gp import Hyper
from driftjax.gp.kernel import KERNELS
from driftjax.gp.likelihood import derivatives, likelihood
from driftjax.gp.model import gram, squared_differences
from driftjax.gp.orthogonal import orthonormal_basis

M = 30
POINT = np.log([0.7, 1.1, 1.6, 0.8, 0.05])  # not at an optimum: no gradient is near 0
CASES = [
    pytest.param(kernel, held, marks=() if held == (kernel == "se") else pytest.mark.slow)
    for kernel in KERNELS
    for held in (False, True)
]


def hyper(x):
    return Hyper(x[:-2], x[-2], x[-1])


def problem(held):
    """Inputs, targets, mask, and directions of which one is none at all."""
    rng = np.random.default_rng(0)
    X, mask = rng.normal(size=(M, 3)), np.arange(M) % 4 != 0
    X[5] = X[6]  # two rows at distance 0
    y = np.where(mask, np.sin(2 * X[:, 0]) + 0.1 * rng.normal(size=M), 0.0)
    J = rng.normal(size=(M, 1, 3)) * [1.0, 30.0, 0.0]
    Q = np.asarray(jax.jit(orthonormal_basis)(J, mask))[0]
    y = y - Q @ (Q.T @ y) if held else y
    return jnp.asarray(X), jnp.asarray(y), jnp.asarray(mask), jnp.asarray(Q) if held else None


def derivatives_and_plain(kernel, held):
    X, y, mask, Q = problem(held)
    plain = lambda x: likelihood(kernel, hyper(x), squared_differences(X), y, mask, Q)
    return jax.jit(lambda x: derivatives(kernel, hyper(x), X, squared_differences(X), y, mask, Q))(POINT), plain


@pytest.mark.parametrize(("kernel", "held"), CASES)
def test_value_and_gradient_equal_autodiff_of_the_plain_likelihood(kernel, held):
    exact, plain = derivatives_and_plain(kernel, held)
    np.testing.assert_allclose(exact.value, jax.jit(plain)(POINT), rtol=1e-12)
    gradient = jax.jit(jax.grad(plain))(POINT)
    np.testing.assert_allclose(exact.gradient, gradient, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("kernel", "held"), CASES)
def test_average_information_is_its_definition_in_dense_matrices(kernel, held):
    """In the space that is left to the targets, of covariance T: y' T^-1 dT_i T^-1 dT_j T^-1 y / 2."""
    exact, _ = derivatives_and_plain(kernel, held)
    X, y, mask, Q = problem(held)
    rows = np.eye(M)[np.asarray(mask)]
    spare = np.zeros((M, 0)) if Q is None else np.asarray(Q)[:, np.linalg.norm(Q, axis=0) > 0.5]
    B = np.linalg.svd(rows @ (np.eye(M) - spare @ spare.T) @ rows.T)[0][:, : len(rows) - spare.shape[1]]
    B = rows.T @ B

    def left(x):
        K = gram(kernel, hyper(x), squared_differences(X), mask, Q)
        cross = K @ spare
        return B.T @ (K - cross @ jnp.linalg.solve(spare.T @ cross, cross.T)) @ B

    T, dT = map(np.asarray, jax.jit(lambda x: (left(x), jax.jacfwd(left)(x)))(POINT))
    w = np.linalg.solve(T, B.T @ np.asarray(y))
    U = np.einsum("abi,b->ai", dT, w)
    np.testing.assert_allclose(exact.information, 0.5 * U.T @ np.linalg.solve(T, U), rtol=1e-7, atol=1e-9)
    values = np.linalg.eigvalsh(exact.information)
    assert values.min() > -1e-12 * values.max() and values.max() > 1


def test_rows_that_are_no_data_change_nothing():
    X, y, mask, _ = problem(False)
    some = np.flatnonzero(mask)
    at = jax.jit(lambda X, y, mask: derivatives("se", hyper(POINT), X, squared_differences(X), y, mask))
    all_rows = at(X, y, mask)
    few = at(*(np.asarray(a)[some] for a in (X, y, mask)))
    for ours, theirs in zip(all_rows, few, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-10)


def test_average_information_is_between_observed_and_expected():
    """For covariances linear in their parameters the mean of both is the average information: s^2 I shows it."""
    _, y, mask, _ = problem(False)
    far = 60.0 * np.arange(M)[:, None] * np.ones(3)  # no two rows are correlated: K = (amplitude + noise) I
    exact = jax.jit(lambda X: derivatives("se", hyper(POINT), X, squared_differences(X), y, mask))(far)
    variance = np.exp(2 * POINT[-2:])
    total, energy = np.sum(variance), np.sum(np.asarray(y) ** 2)
    expected = 0.5 * energy * np.outer(2 * variance, 2 * variance) / total**3
    information = np.asarray(exact.information)
    np.testing.assert_allclose(information[-2:, -2:], expected, rtol=1e-9)
    np.testing.assert_allclose(information[:-2], 0.0, atol=1e-7)
