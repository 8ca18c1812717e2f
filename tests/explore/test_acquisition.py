"""Predicted errors and knowledge gradients against quadrature, sampling and conditioning by the textbook."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from driftjax.explore.acquisition import Prediction, assess_candidates, expected_magnitude, least_error, sampled_errors
from driftjax.gp import GP, condition, zero_gp
from driftjax.gp.model import Hyper

C, T, ROWS = 3, 4, 12


@pytest.fixture(scope="module")
def gp() -> GP:
    rng = np.random.default_rng(0)
    Z, Y = jnp.asarray(rng.normal(size=(ROWS, 5))), jnp.asarray(rng.normal(size=(ROWS, 3)))
    hyper = Hyper(jnp.asarray(rng.uniform(0.0, 0.7, (3, 5))), jnp.array([0.1, -0.2, 0.0]), jnp.log(jnp.full(3, 0.3)))
    mask = jnp.arange(ROWS) < ROWS - 2
    return condition(Z, Y, mask, hyper, jnp.array([1.0, 2.0, 1.0, 0.5, 1.0]), jnp.array([1.0, 0.5, 2.0]), "se")


def prediction(seed: int = 1, far: float = 0.5) -> Prediction:
    rng = np.random.default_rng(seed)
    G = 0.1 * rng.normal(size=(C, T, T, 3)) * np.tril(np.ones((T, T)), -1)[None, :, :, None]
    z, mean = far * rng.normal(size=(C, T, 5)), 0.05 * rng.normal(size=(C, T))
    weight = np.full((C, T), 1 / T)
    z, mean, G, weight = (jnp.asarray(values) for values in (z, mean, G, weight))
    return Prediction(z, mean, G, weight, jnp.asarray(3.0), jnp.ones(C, bool))


def joint(gp: GP, z: np.ndarray) -> np.ndarray:
    """Posterior covariance (3, P, P) by the inverse of the Gram matrix, in numbers of NumPy."""
    h, keep = gp.hyper, np.asarray(gp.mask)
    out = []
    for k in range(3):
        length, size = np.exp(np.asarray(h.log_lengthscale[k])) * np.asarray(gp.scale), np.exp(2 * h.log_amplitude[k])
        kernel = lambda a, b, length=length, size=size: (
            size * np.exp(-0.5 * np.sum(((a[:, None] - b[None]) / length) ** 2, axis=-1))
        )
        Z = np.asarray(gp.Z)[keep]
        K = kernel(Z, Z) + np.exp(2 * h.log_noise[k]) * np.eye(len(Z))
        cross = kernel(z, Z)
        out.append((kernel(z, z) - cross @ np.linalg.solve(K, cross.T)) * gp.output_scale[k] ** 2)
    return np.array(out)


def test_covariance_is_that_of_the_textbook_and_its_diagonal_the_variance(gp):
    z = prediction().z.reshape(-1, 5)
    covariance = gp.covariance(z)
    np.testing.assert_allclose(covariance, joint(gp, np.asarray(z)), atol=1e-10)
    np.testing.assert_allclose(jnp.diagonal(covariance, axis1=1, axis2=2).T, jax.vmap(gp.variance)(z), atol=1e-12)


@pytest.mark.parametrize(("mean", "deviation"), [(0.3, 0.2), (-0.3, 0.2), (0.0, 1.0), (2.0, 0.1), (0.1, 0.0)])
def test_expected_magnitude_equals_quadrature(mean, deviation):
    got = expected_magnitude(jnp.asarray(mean), jnp.asarray(deviation))
    reach = 9 * deviation
    density = lambda e: abs(e) * norm.pdf(e, mean, deviation)
    expected = quad(density, mean - reach, mean + reach, points=[0.0])[0] if deviation else abs(mean)
    assert got == pytest.approx(expected, rel=1e-6)
    slope = jax.grad(expected_magnitude, 1)(jnp.asarray(mean), jnp.asarray(deviation))
    assert bool(jnp.isfinite(slope))


def test_expected_error_is_the_mean_over_sampled_laps(gp):
    p = prediction()
    assessed = eqx.filter_jit(assess_candidates)(p, gp, jnp.asarray(1.0), jax.random.key(0))
    laps = eqx.filter_jit(sampled_errors)(p, gp, jax.random.key(1), 4000)
    standard = np.std(np.asarray(laps), axis=0) / np.sqrt(len(laps))
    assert np.all(np.abs(assessed.error - jnp.mean(laps, axis=0)) < 4 * standard)
    assert np.all(standard < 0.05 * assessed.error)


def test_knowledge_gradient_equals_conditioning_on_sampled_rows(gp):
    """Sample rows of each candidate, condition on them, and take the mean of the least expected error."""
    p, rng = prediction(), np.random.default_rng(3)
    assessed = eqx.filter_jit(assess_candidates)(p, gp, jnp.asarray(1.0), jax.random.key(0))
    K = joint(gp, np.asarray(p.z).reshape(-1, 5)).reshape(3, C, T, C, T)
    G, noise = np.asarray(p.G), np.asarray(gp.noise_variance) / 3.0
    expected_error = lambda m, v: np.mean(
        np.asarray(expected_magnitude(jnp.asarray(m), jnp.sqrt(jnp.maximum(jnp.asarray(v), 0.0)))), axis=-1
    )
    variance = np.einsum("atkj,jakam,atmj->at", G, K, G)
    scatter = np.einsum("atkj,j->at", G**2, np.asarray(gp.noise_variance))
    np.testing.assert_allclose(assessed.error, expected_error(np.asarray(p.mean), variance + scatter), rtol=1e-10)
    for c in range(C):
        draws = []
        for _ in range(600):
            mean, left = np.array(p.mean), variance + scatter
            for j in range(3):
                own = K[j, c, :, c, :] + noise[j] * np.eye(T)
                y = rng.multivariate_normal(np.zeros(T), own)
                cross = K[j, :, :, c, :]  # (C, T, T)
                mean += np.einsum("atk,akm,m->at", G[..., j], cross, np.linalg.solve(own, y))
                shrink = np.einsum("akm,mn,abn->akb", cross, np.linalg.inv(own), cross)
                left -= np.einsum("atk,akm,atm->at", G[..., j], shrink, G[..., j])
            draws.append(expected_error(mean, left).min())
        gain = float(assessed.error.min() - np.mean(draws))
        # both are means over draws: 64 here, 600 there
        assert float(assessed.gain[c]) == pytest.approx(gain, abs=4 * np.std(draws) * np.sqrt(1 / 64 + 1 / 600))


def test_an_unknown_promising_candidate_is_preferred_to_a_known_poor_and_an_unknown_hopeless_one(gp):
    p = prediction()
    known, unknown = gp.Z[0], jnp.full(5, 3.0)
    z = jnp.stack([jnp.broadcast_to(at, (T, 5)) for at in (known, unknown, -unknown)])
    mean = jnp.array([[0.10], [0.06], [2.0]]) * jnp.ones((C, T))
    p = eqx.tree_at(lambda p: (p.z, p.mean, p.G), p, (z, mean, jnp.broadcast_to(0.3 * p.G[0], p.G.shape)))
    assessed = eqx.filter_jit(assess_candidates)(p, gp, jnp.asarray(5.0), jax.random.key(0))
    assert assessed.deviation[1] > 2 * assessed.deviation[0]
    assert jnp.argmax(assessed.gain) == 1
    assert least_error(assessed.error - 3 * assessed.gain, p.drivable) == 1
    blocked = jnp.array([True, False, True])
    assert least_error(assessed.error - 3 * assessed.gain, blocked) == 0


def test_nothing_is_gained_by_what_changes_no_lateral_error(gp):
    p = eqx.tree_at(lambda p: p.G, prediction(), jnp.zeros((C, T, T, 3)))
    assessed = eqx.filter_jit(assess_candidates)(p, gp, jnp.asarray(1.0), jax.random.key(0))
    np.testing.assert_allclose(assessed.gain, 0.0, atol=1e-12)
    np.testing.assert_allclose(assessed.error, jnp.mean(jnp.abs(p.mean), axis=1))
    np.testing.assert_array_equal(assessed.on_road, 1.0)


def test_without_data_the_covariance_is_the_kernel():
    gp, z = zero_gp(6, 5, 3), jnp.asarray(np.random.default_rng(2).normal(size=(4, 5)))
    squares = jnp.sum((z[:, None] - z[None]) ** 2, axis=-1)
    np.testing.assert_allclose(gp.covariance(z)[1], jnp.exp(-0.5 * squares), atol=1e-12)
