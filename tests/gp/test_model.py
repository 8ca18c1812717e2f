"""The posterior against scikit-learn, padding, limits, and derivatives against central differences."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gp_data import smooth
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

from driftjax.gp import Hyper, condition, data_scales, zero_gp
from driftjax.gp.likelihood import likelihood
from driftjax.gp.model import squared_differences

LENGTH = np.array([[0.7, 1.1, 1.6], [1.3, 0.6, 0.9]])
AMPLITUDE, NOISE = np.array([0.8, 1.7]), np.array([0.05, 0.2])
HYPER = Hyper(jnp.log(LENGTH), jnp.log(AMPLITUDE), jnp.log(NOISE))


def build(Z, Y, kernel="se", mask=None, fixed=None):
    Z, Y = jnp.asarray(Z), jnp.asarray(Y)
    mask = jnp.ones(len(Z), bool) if mask is None else jnp.asarray(mask)
    scale, output_scale = data_scales(Z, Y, mask) if fixed is None else fixed
    return eqx.filter_jit(condition)(Z, Y, mask, HYPER, scale, output_scale, kernel)


def sklearn_gp(gp, Y, kernel, d) -> Any:  # scikit-learn's stubs are wrong about its arguments
    regressor: Any = GaussianProcessRegressor
    length: Any = LENGTH[d]
    shape: Any = {"se": RBF(length), "matern52": Matern(length, nu=2.5)}[kernel]
    k = ConstantKernel(float(AMPLITUDE[d] ** 2)) * shape + WhiteKernel(float(NOISE[d] ** 2))
    model = regressor(k, alpha=0, optimizer=None)
    return model.fit(np.asarray(gp.Z / gp.scale), Y[:, d] / np.asarray(gp.output_scale)[d])


@pytest.mark.parametrize("kernel", ["se", "matern52"])
def test_mean_variance_and_likelihood_equal_scikit_learn(kernel):
    Z, Y = smooth(60)
    gp = build(Z, Y, kernel)
    points = jnp.asarray(smooth(20, seed=1)[0])
    mean, variance = jax.vmap(gp.mean)(points), jax.vmap(gp.variance)(points)
    for d in range(2):
        other = sklearn_gp(gp, Y, kernel, d)
        m, s = other.predict(np.asarray(points / gp.scale), return_std=True)
        scale = float(gp.output_scale[d])
        np.testing.assert_allclose(mean[:, d], m * scale, rtol=1e-8, atol=1e-10 * scale)
        # scikit-learn's predictive variance contains the noise, ours is the latent function's
        np.testing.assert_allclose(variance[:, d] / scale**2, s**2 - NOISE[d] ** 2, rtol=1e-6, atol=1e-12)
        hyper = jax.tree.map(lambda leaf, d=d: leaf[d], HYPER)
        y = jnp.asarray(Y[:, d]) / scale
        ours = likelihood(kernel, hyper, squared_differences(gp.Z / gp.scale), y, gp.mask)
        np.testing.assert_allclose(ours, other.log_marginal_likelihood_value_, rtol=1e-8)


@pytest.mark.parametrize("kernel", ["se", "matern52"])
def test_padding_changes_nothing(kernel):
    Z, Y = smooth(25)
    plain = build(Z, Y, kernel)
    junk = np.full((15, 3), np.nan), np.full((15, 2), np.inf)
    order = np.random.default_rng(3).permutation(40)  # padding anywhere, not only at the end
    mask = (np.arange(40) < 25)[order]
    padded = build(np.concatenate([Z, junk[0]])[order], np.concatenate([Y, junk[1]])[order], kernel, mask)
    points = jnp.asarray(smooth(5, seed=2)[0])

    @eqx.filter_jit
    def everything(gp):
        return [jax.vmap(f)(points) for f in (gp.mean, gp.variance, gp.bounded_mean, gp.fade)]

    for ours, theirs in zip(everything(padded), everything(plain), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-13)
    slope = jax.jacfwd(padded.bounded_mean)(jnp.asarray(Z[0]))
    np.testing.assert_allclose(slope, jax.jacfwd(plain.bounded_mean)(jnp.asarray(Z[0])), rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("kernel", ["se", "matern52"])
def test_derivatives_equal_central_differences(kernel):
    Z, Y = smooth(30)
    gp = build(Z, Y, kernel)
    z = gp.Z[0] + gp.scale * jnp.array([0.1, -0.2, 0.05])
    for f in (gp.mean, gp.bounded_mean, gp.variance):
        for point in (z, gp.Z[3]):  # also exactly at a data point, where Matern's distance has a kink
            steps = jnp.diag(1e-5 * gp.scale)
            ends = jax.jit(jax.vmap(f))(jnp.concatenate([point + steps, point - steps]))
            difference = (ends[:3] - ends[3:]) / (2e-5 * gp.scale[:, None])
            np.testing.assert_allclose(jax.jit(jax.jacrev(f))(point), difference.T, rtol=2e-5, atol=1e-9)


@pytest.mark.parametrize("kernel", ["se", "matern52"])
def test_likelihood_gradient_equals_central_differences(kernel):
    Z, Y = smooth(30)
    gp = build(Z, Y, kernel, mask=np.arange(30) < 22)
    pairs, y = squared_differences(gp.Z / gp.scale), jnp.where(gp.mask, jnp.asarray(Y[:, 0]) / gp.output_scale[0], 0)

    def value(x):
        return likelihood(kernel, Hyper(x[:3], x[3], x[4]), pairs, y, gp.mask)

    x = jnp.log(jnp.array([0.7, 1.1, 1.6, 0.8, 0.05]))
    difference = jax.vmap(lambda h: (value(x + h) - value(x - h)) / 2e-5)(1e-5 * jnp.eye(5))
    np.testing.assert_allclose(jax.grad(value)(x), difference, rtol=1e-6, atol=1e-6)


def test_far_from_data_is_the_prior():
    gp = build(*smooth(40))
    far = gp.Z.mean(axis=0) + 40 * gp.scale
    assert jnp.all(jnp.abs(gp.mean(far)) < 1e-12) and jnp.all(gp.fade(far) < 1e-12)
    assert jnp.all(jnp.abs(gp.bounded_mean(far)) < 1e-12)
    np.testing.assert_allclose(gp.variance(far), gp.prior_variance, rtol=1e-12)
    assert jnp.all(jnp.isfinite(jax.jacfwd(gp.bounded_mean)(far)))


def test_bounded_mean_is_the_mean_inside_data_and_stays_within_twice_the_targets():
    Z, Y = smooth(80)
    gp = build(Z, Y)
    inside = gp.Z.mean(axis=0) + 0.6 * (jnp.asarray(smooth(50, seed=5)[0]) - gp.Z.mean(axis=0))
    mean, bounded = jax.vmap(gp.mean)(inside), jax.vmap(gp.bounded_mean)(inside)
    seen = jnp.max(jnp.abs(jnp.asarray(Y)), axis=0)
    within = jnp.abs(mean) <= seen
    assert jnp.mean(within) > 0.9
    assert jnp.all(jnp.where(within, jnp.abs(bounded - mean) - 0.02 * jnp.abs(mean), 0.0) < 1e-3 * gp.output_scale)
    wild = eqx.tree_at(lambda g: g.alpha, gp, 100 * gp.alpha)  # far beyond any target
    assert jnp.any(jnp.abs(jax.vmap(wild.mean)(inside)) > 2 * seen)
    assert jnp.all(jnp.abs(jax.vmap(wild.bounded_mean)(inside)) <= 2 * seen)


def test_without_data_the_gp_is_its_prior_and_has_the_shapes_of_a_fitted_one():
    empty, full = zero_gp(30, 3, 2), build(*smooth(30))
    z = jnp.array([12.0, -0.4, 6e3])
    assert jnp.all(empty.mean(z) == 0) and jnp.all(empty.bounded_mean(z) == 0)
    np.testing.assert_array_equal(empty.variance(z), empty.prior_variance)
    assert jax.tree.structure(empty) == jax.tree.structure(full)
    same = jax.tree.map(lambda p, q: p.shape == q.shape and p.dtype == q.dtype, empty, full)
    assert all(jax.tree.leaves(same))


def test_growing_data_never_recompiles():
    traces = []

    @eqx.filter_jit
    def mean(gp, z):
        traces.append(1)
        return gp.mean(z)

    Z, Y = smooth(30)
    for n in (0, 7, 30):
        mean(build(Z, Y, mask=np.arange(30) < n), jnp.asarray(Z[0]))
    mean(zero_gp(30, 3, 2), jnp.asarray(Z[0]))
    assert len(traces) == 1


def test_more_data_never_raises_the_variance():
    Z, Y = smooth(40)
    fixed = data_scales(jnp.asarray(Z), jnp.asarray(Y), jnp.ones(40, bool))
    few, many = (build(Z, Y, mask=np.arange(40) < n, fixed=fixed) for n in (10, 40))
    points = jnp.asarray(smooth(30, seed=8)[0])
    assert jnp.all(jax.vmap(many.variance)(points) <= jax.vmap(few.variance)(points) + 1e-12)
