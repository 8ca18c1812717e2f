"""The orthogonal GP against the dense algebra of its prior; what known causes can say it leaves to them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gp_data import smooth

from driftjax.gp import Hyper, condition, data_scales, fit_masked, predict_known_effects, project_out
from driftjax.gp.likelihood import likelihood
from driftjax.gp.model import squared_differences
from driftjax.gp.orthogonal import orthonormal_basis

N, D, K = 50, 2, 3
LENGTH = np.array([[0.7, 1.1, 1.6], [1.3, 0.6, 0.9]])
AMPLITUDE, NOISE = np.array([0.8, 1.7]), np.array([0.05, 0.2])
HYPER = Hyper(*(jnp.asarray(np.log(value)) for value in (LENGTH, AMPLITUDE, NOISE)))


def basis_at(Z):
    """Directions (N, D, K) of unlike units; the second output has two only, its third is their sum."""
    V, beta, F = (Z - [12.0, -0.4, 6e3]).T / np.array([[3.0], [0.2], [4e3]])
    first = np.stack([V, 1e3 * np.sin(2 * beta), 1e-3 * V * F], axis=1)
    second = np.stack([beta, F**2, beta + F**2], axis=1)
    return np.stack([first, second], axis=1)


@pytest.fixture(scope="module")
def data():
    Z, Y = smooth(N)
    return Z, Y, basis_at(Z)


@jax.jit
def conditioned(Z, Y, mask, basis):
    left = Y if basis is None else project_out(Y, basis, mask)
    return condition(Z, Y, mask, HYPER, *data_scales(Z, left, mask), "se", basis)


def at(f, points):
    """Values of `f` at many points, as one program for all GPs of one shape."""
    return np.asarray(eqx.filter_jit(eqx.filter_vmap(f))(points))


def built(Z, Y, basis, mask=None):
    return jax.device_get(conditioned(Z, Y, np.ones(len(Z), bool) if mask is None else mask, basis))


def dense(gp, Y, J, points, d):
    """Mean, variance and log likelihood by k_perp written out, for output `d`; J of full rank."""
    scaled = lambda A: np.asarray(A / gp.scale)
    k = lambda A, B: (
        AMPLITUDE[d] ** 2 * np.exp(-0.5 * np.sum(((scaled(A)[:, None] - scaled(B)[None]) / LENGTH[d]) ** 2, axis=-1))
    )
    X, y = np.asarray(gp.Z), np.asarray(Y[:, d] / gp.output_scale[d])
    P = np.eye(len(X)) - J @ np.linalg.pinv(J)
    U, C = k(X, X) @ J, J.T @ k(X, X) @ J
    perp = lambda A, B: k(A, B) - k(A, X) @ J @ np.linalg.solve(C, J.T @ k(X, B))
    S = perp(X, X) + NOISE[d] ** 2 * np.eye(len(X))
    mean = perp(points, X) @ np.linalg.solve(S, P @ y)
    variance = np.diag(perp(points, points) - perp(points, X) @ np.linalg.solve(S, perp(X, points)))
    B = np.linalg.svd(P)[0][:, : len(X) - J.shape[1]]
    w, T = B.T @ y, B.T @ S @ B
    value = -0.5 * w @ np.linalg.solve(T, w) - 0.5 * np.linalg.slogdet(T)[1] - 0.5 * len(w) * np.log(2 * np.pi)
    assert np.abs(J.T @ perp(X, X)).max() < 1e-6 * np.abs(U).max()
    return mean, variance, value


@pytest.mark.parametrize("d", range(D))
def test_mean_variance_and_likelihood_equal_those_of_the_conditioned_prior(data, d):
    Z, Y, basis = data
    gp, points = built(*data), smooth(20, seed=1)[0]
    J = basis[:, d, : K - d]  # of the second output two columns say all
    J = J / np.linalg.norm(J, axis=0)
    mean, variance, value = dense(gp, Y, J, points, d)
    scale = float(gp.output_scale[d])
    np.testing.assert_allclose(at(gp.mean, points)[:, d], scale * mean, rtol=1e-6, atol=1e-8 * scale)
    np.testing.assert_allclose(at(gp.variance, points)[:, d], scale**2 * variance, rtol=1e-5, atol=1e-9 * scale**2)
    hyper = jax.tree.map(lambda a: a[d], HYPER)

    @jax.jit
    def value_of(gp):
        Q, y = orthonormal_basis(basis, gp.mask)[d], project_out(Y, basis, gp.mask)[:, d]
        return likelihood("se", hyper, squared_differences(gp.Z / gp.scale), y / scale, gp.mask, Q)

    posterior = value_of(gp)
    np.testing.assert_allclose(posterior, value, rtol=1e-6)


def test_the_mean_at_the_data_is_orthogonal_to_what_known_causes_can_do(data):
    gp, basis = built(*data), data[2]
    mean = at(gp.mean, gp.Z)
    for d in range(D):
        J = basis[:, d] / np.linalg.norm(basis[:, d], axis=0)
        assert np.abs(J.T @ mean[:, d]).max() < 1e-6 * np.linalg.norm(mean[:, d])
        plain = at(built(data[0], data[1], None).mean, gp.Z)[:, d]
        assert np.abs(J.T @ plain).max() > 0.1 * np.linalg.norm(plain)


def test_what_known_causes_can_say_is_left_to_them_and_found_elsewhere(data):
    Z, Y, basis = data
    caused = basis @ np.array([0.5, 2e-3, 300.0])
    mask = np.ones(N, bool)
    assert np.abs(jax.jit(project_out)(caused, basis, mask)).max() < 1e-9 * np.abs(caused).max()
    with_causes, without = (at(built(Z, y, basis).mean, Z) for y in (Y + caused, Y))
    np.testing.assert_allclose(with_causes, without, rtol=1e-6, atol=1e-7 * np.abs(caused).max())
    other = basis_at(smooth(30, seed=2)[0])
    predicted = jax.jit(predict_known_effects)(caused, basis, mask, other)
    np.testing.assert_allclose(predicted, other @ np.array([0.5, 2e-3, 300.0]), rtol=1e-6, atol=1e-9)


def test_rows_that_are_no_data_change_nothing(data):
    Z, Y, basis = data
    few = built(Z[:30], Y[:30], basis[:30])
    junk = np.where(np.arange(N)[:, None, None] < 30, basis, np.nan)
    many = built(Z, Y, junk, np.arange(N) < 30)
    point = Z[3:4] * 1.01
    np.testing.assert_allclose(at(many.mean, point), at(few.mean, point), rtol=1e-8)
    np.testing.assert_allclose(at(many.variance, point), at(few.variance, point), rtol=1e-6)


def test_a_basis_of_zeros_is_the_plain_gp(data):
    Z, Y, basis = data
    plain, held = built(Z, Y, None), built(Z, Y, np.zeros_like(basis))
    for name in ("alpha", "L", "scale", "output_scale", "lower", "upper"):
        np.testing.assert_array_equal(getattr(held, name), getattr(plain, name))


def test_the_fit_leaves_known_causes_alone(data):
    """Hyper-parameters and mean are the same whatever the known causes do, and the likelihood has no lower start."""
    Z, Y, basis = (jnp.asarray(a) for a in data)
    caused = basis @ jnp.asarray([0.5, 2e-3, 300.0])
    mask, key = jnp.ones(N, bool), jax.random.key(0)
    one, two = (fit_masked(Z, y, mask, num_fit=40, basis=basis, key=key) for y in (Y, Y + caused))
    np.testing.assert_allclose(two.log_marginal_likelihood, one.log_marginal_likelihood, rtol=1e-4)
    mean, other = (at(fitted.gp.mean, Z) for fitted in (one, two))
    np.testing.assert_allclose(other, mean, atol=1e-2 * np.abs(mean).max())
    assert jnp.all(jnp.isfinite(one.log_marginal_likelihood)) and jnp.all(one.error < 0.1)
