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
KERNELS = ("se", pytest.param("matern52", marks=pytest.mark.slow))  # values of both are compared by default
HYPER = Hyper(*(jnp.asarray(np.log(value)) for value in (LENGTH, AMPLITUDE, NOISE)))


@eqx.filter_jit
def conditioned(Z, Y, mask, kernel, fixed):
    scale, output_scale = data_scales(Z, Y, mask) if fixed is None else fixed
    return condition(Z, Y, mask, HYPER, scale, output_scale, kernel)


def build(Z, Y, kernel="se", mask=None, fixed=None):
    mask = np.ones(len(Z), bool) if mask is None else mask
    return jax.device_get(conditioned(Z, Y, mask, kernel, fixed))  # NumPy: tests compute with it on the host


def at(f, points):
    """Values of `f` at many points, as one program for all GPs of one shape."""
    return np.asarray(eqx.filter_jit(eqx.filter_vmap(f))(points))


def slope(f, z):
    return eqx.filter_jit(lambda f, z: jax.jacfwd(f)(z))(f, z)


def sklearn_gp(gp, Y, kernel, d) -> Any:  # scikit-learn's stubs are wrong about its arguments
    regressor: Any = GaussianProcessRegressor
    length: Any = LENGTH[d]
    shape: Any = {"se": RBF(length), "matern52": Matern(length, nu=2.5)}[kernel]
    k = ConstantKernel(float(AMPLITUDE[d] ** 2)) * shape + WhiteKernel(float(NOISE[d] ** 2))
    model = regressor(k, alpha=0, optimizer=None)
    return model.fit(gp.Z / gp.scale, Y[:, d] / gp.output_scale[d])


@pytest.mark.parametrize("kernel", ["se", "matern52"])
def test_mean_variance_and_likelihood_equal_scikit_learn(kernel):
    Z, Y = smooth(60)
    gp = build(Z, Y, kernel)
    points = smooth(20, seed=1)[0]
    mean, variance = at(gp.mean, points), at(gp.variance, points)
    pairs = jax.jit(squared_differences)(gp.Z / gp.scale)
    for d in range(2):
        other = sklearn_gp(gp, Y, kernel, d)
        m, s = other.predict(points / gp.scale, return_std=True)
        scale = float(gp.output_scale[d])
        np.testing.assert_allclose(mean[:, d], m * scale, rtol=1e-8, atol=1e-10 * scale)
        # scikit-learn's predictive variance contains the noise, ours is the latent function's
        np.testing.assert_allclose(variance[:, d] / scale**2, s**2 - NOISE[d] ** 2, rtol=1e-6, atol=1e-12)
        hyper = jax.tree.map(lambda leaf, d=d: leaf[d], HYPER)
        ours = eqx.filter_jit(likelihood)(kernel, hyper, pairs, Y[:, d] / scale, gp.mask)
        np.testing.assert_allclose(ours, other.log_marginal_likelihood_value_, rtol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS)
def test_padding_changes_nothing(kernel):
    Z, Y = smooth(25)
    plain = build(Z, Y, kernel)
    junk = np.full((15, 3), np.nan), np.full((15, 2), np.inf)
    order = np.random.default_rng(3).permutation(40)  # padding anywhere, not only at the end
    mask = (np.arange(40) < 25)[order]
    padded = build(np.concatenate([Z, junk[0]])[order], np.concatenate([Y, junk[1]])[order], kernel, mask)
    points = smooth(5, seed=2)[0]

    @eqx.filter_jit
    def everything(gp):
        values = [jax.vmap(f)(points) for f in (gp.mean, gp.variance, gp.bounded_mean, gp.fade)]
        return values, jax.jacfwd(gp.bounded_mean)(Z[0])

    (ours, our_slope), (theirs, their_slope) = everything(padded), everything(plain)
    for our, their in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(our, their, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(our_slope, their_slope, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS)
def test_derivatives_equal_central_differences(kernel):
    Z, Y = smooth(30)
    gp, gradient = build(Z, Y, kernel), eqx.filter_jit(lambda f, z: jax.jacrev(f)(z))
    z = gp.Z[0] + gp.scale * np.array([0.1, -0.2, 0.05])
    for f in (gp.mean, gp.bounded_mean, gp.variance):
        for point in (z, gp.Z[3]):  # also exactly at a data point, where Matern's distance has a kink
            steps = np.diag(1e-5 * gp.scale)
            ends = at(f, np.concatenate([point + steps, point - steps]))
            difference = (ends[:3] - ends[3:]) / (2e-5 * gp.scale[:, None])
            np.testing.assert_allclose(gradient(f, point), difference.T, rtol=2e-5, atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS)
def test_likelihood_gradient_equals_central_differences(kernel):
    Z, Y = smooth(30)
    gp = build(Z, Y, kernel, mask=np.arange(30) < 22)
    X, y = map(jnp.asarray, (gp.Z / gp.scale, np.where(gp.mask, Y[:, 0] / gp.output_scale[0], 0)))

    def value(x):
        return likelihood(kernel, Hyper(x[:3], x[3], x[4]), squared_differences(X), y, gp.mask)

    x, steps = np.log([0.7, 1.1, 1.6, 0.8, 0.05]), 1e-5 * np.eye(5)
    up, down = np.split(jax.jit(jax.vmap(value))(np.concatenate([x + steps, x - steps])), 2)
    np.testing.assert_allclose(jax.jit(jax.grad(value))(x), (up - down) / 2e-5, rtol=1e-6, atol=1e-6)


def test_far_from_data_is_the_prior():
    gp = build(*smooth(40))
    far = gp.Z.mean(axis=0) + 40 * gp.scale
    mean, fade, bounded, variance = eqx.filter_jit(
        lambda gp: (gp.mean(far), gp.fade(far), gp.bounded_mean(far), gp.variance(far))
    )(gp)
    assert np.all(np.abs(mean) < 1e-12) and np.all(fade < 1e-12)
    assert np.all(np.abs(bounded) < 1e-12)
    np.testing.assert_allclose(variance, gp.prior_variance, rtol=1e-12)
    assert np.all(np.isfinite(slope(gp.bounded_mean, far)))


def test_bounded_mean_is_the_mean_inside_data_and_stays_within_twice_the_targets():
    Z, Y = smooth(80)
    gp = build(Z, Y)
    inside = gp.Z.mean(axis=0) + 0.6 * (smooth(50, seed=5)[0] - gp.Z.mean(axis=0))
    mean, bounded = at(gp.mean, inside), at(gp.bounded_mean, inside)
    seen = np.max(np.abs(Y), axis=0)
    within = np.abs(mean) <= seen
    assert np.mean(within) > 0.9
    assert np.all(np.where(within, np.abs(bounded - mean) - 0.02 * np.abs(mean), 0.0) < 1e-3 * gp.output_scale)
    wild = eqx.tree_at(lambda g: g.alpha, gp, 100 * gp.alpha)  # far beyond any target
    assert np.any(np.abs(at(wild.mean, inside)) > 2 * seen)
    assert np.all(np.abs(at(wild.bounded_mean, inside)) <= 2 * seen)


def test_without_data_the_gp_is_its_prior_and_has_the_shapes_of_a_fitted_one():
    empty, full = eqx.filter_jit(zero_gp)(30, 3, 2), build(*smooth(30))
    z = np.array([12.0, -0.4, 6e3])
    mean, bounded, variance, prior = eqx.filter_jit(
        lambda gp: (gp.mean(z), gp.bounded_mean(z), gp.variance(z), gp.prior_variance)
    )(empty)
    assert np.all(mean == 0) and np.all(bounded == 0)
    np.testing.assert_array_equal(variance, prior)
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
        mean(build(Z, Y, mask=np.arange(30) < n), Z[0])
    mean(eqx.filter_jit(zero_gp)(30, 3, 2), Z[0])
    assert len(traces) == 1


def test_more_data_never_raises_the_variance():
    Z, Y = smooth(40)
    fixed = jax.jit(data_scales)(Z, Y, np.ones(40, bool))
    few, many = (build(Z, Y, mask=np.arange(40) < n, fixed=fixed) for n in (10, 40))
    points = smooth(30, seed=8)[0]
    assert np.all(at(many.variance, points) <= at(few.variance, points) + 1e-12)
