"""The fit of any kernel against the closed form, against scikit-learn's, and where it must fail."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gp_data import smooth
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

from driftjax.core import RESULTS
from driftjax.core.bounded_newton import minimise_batch
from driftjax.gp import Hyper, data_scales, fit_kernel
from driftjax.gp.likelihood import derivatives
from driftjax.gp.model import condition, squared_differences

KEY, N = jax.random.key(0), 40
BOUNDS = {"amplitude": (0.05, 20.0), "length": (0.1, 20.0)}  # as `gp.fit`
NOISE = (1e-3, 2.0)


def separation(p, a, b):
    return jnp.sum(((a - b) / p["length"]) ** 2)


def squared_exponential(p, a, b):
    return p["amplitude"] ** 2 * jnp.exp(-0.5 * separation(p, a, b))


def matern32(p, a, b):
    q = 3 * separation(p, a, b)
    r = jnp.where(q > 0, jnp.sqrt(jnp.where(q > 0, q, 1.0)), 0.0)  # its derivative at 0 is 0
    return p["amplitude"] ** 2 * (1 + r) * jnp.exp(-r)


def box(nf=3):
    return ({"amplitude": BOUNDS["amplitude"][i], "length": np.full(nf, BOUNDS["length"][i])} for i in (0, 1))


def scaled(seed=0, noise=0.05) -> Any:
    Z, Y = smooth(N, D=1, seed=seed, noise=noise)
    scale, output_scale = map(np.asarray, jax.jit(data_scales)(Z, Y, np.ones(N, bool)))
    return Z / scale, Y[:, 0] / output_scale[0]


def fitted(kernel, Z, y, **options):
    return fit_kernel(kernel, Z, y, *box(Z.shape[1]), noise=NOISE, key=KEY, **options)


def test_the_shipped_kernel_as_a_function_has_the_optimum_of_the_closed_form():
    Z, y = scaled()
    X, mask = Z - Z.mean(axis=0), jnp.asarray(np.ones(N, bool))
    ours = fitted(squared_exponential, Z, y)
    assert ours.result == RESULTS.successful and ours.error <= 1e-6
    hyper = lambda x: Hyper(x[..., :-2], x[..., -2], x[..., -1])

    def closed(x):
        value, gradient, information = derivatives("se", hyper(x), X, squared_differences(X), y, mask)
        return -value / N, -gradient / N, information / N

    low, high = (np.log([BOUNDS["length"][i]] * 3 + [BOUNDS["amplitude"][i], NOISE[i]]) for i in (0, 1))
    start = np.log([1.0, 1.0, 1.0, 1.0, 0.1])
    other = eqx.filter_jit(
        lambda start, low, high: minimise_batch(closed, start, low, high, max_iterations=100, tolerance=1e-6)
    )(start, low, high)
    assert other.result == RESULTS.successful
    hyperparameters = np.log([*ours.parameters["length"], ours.parameters["amplitude"], ours.noise])
    np.testing.assert_allclose(hyperparameters, other.x, atol=2e-4)
    np.testing.assert_allclose(ours.log_marginal_likelihood, -N * other.value, rtol=1e-8)

    gp = eqx.filter_jit(condition)(Z, y[:, None], mask, hyper(other.x[None]), jnp.ones(3), jnp.ones(1), "se")
    at = jax.jit(jax.vmap(lambda z: (ours.mean(z), gp.mean(z)[0], ours.variance(z), gp.variance(z)[0])))
    mean, closed_mean, variance, closed_variance = at(Z[:3] + 0.3)
    np.testing.assert_allclose(mean, closed_mean, atol=1e-4)
    np.testing.assert_allclose(variance, closed_variance, atol=1e-5)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize(
    ("kernel", "theirs"),
    [(squared_exponential, RBF), pytest.param(matern32, partial(Matern, nu=1.5), marks=pytest.mark.slow)],
)
def test_the_optimum_is_that_of_scikit_learn(kernel, theirs):
    Z, y = scaled(1, 0.2)
    ours = fitted(kernel, Z, y)
    assert ours.result == RESULTS.successful
    square = lambda pair: (pair[0] ** 2, pair[1] ** 2)
    lengths: Any = np.ones(3)
    signal = ConstantKernel(1.0, square(BOUNDS["amplitude"])) * theirs(lengths, BOUNDS["length"])
    other: Any = GaussianProcessRegressor(
        signal + WhiteKernel(0.01, square(NOISE)), alpha=0, n_restarts_optimizer=2, random_state=0
    )
    other.fit(np.asarray(Z), np.asarray(y))
    np.testing.assert_allclose(ours.log_marginal_likelihood, other.log_marginal_likelihood_value_, atol=1e-4)
    p = ours.parameters
    hyperparameters = np.log([p["amplitude"] ** 2, *p["length"], ours.noise**2])
    np.testing.assert_allclose(hyperparameters, other.kernel_.theta, atol=0.02)  # theirs stops earlier
    points = Z[:5] + 0.4
    mean, std = other.predict(np.asarray(points), return_std=True)
    np.testing.assert_allclose(jax.jit(jax.vmap(ours.mean))(points), mean, atol=2e-3)
    variance = std**2 - np.exp(other.kernel_.theta[-1])  # theirs counts the noise
    np.testing.assert_allclose(jax.jit(jax.vmap(ours.variance))(points), variance, atol=2e-3)


def test_the_posterior_mean_has_a_gradient_by_its_input():
    Z, y = scaled()
    gp = fitted(matern32, Z, y)
    z, step = Z[0] + 0.2, 1e-5
    mean, ends = jax.jit(jax.vmap(gp.mean)), step * np.eye(3)
    numbers = (np.asarray(mean(z + ends)) - mean(z - ends)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(gp.mean))(z), numbers, rtol=1e-5, atol=1e-8)


def test_a_kernel_that_is_not_positive_definite_is_reported():
    Z, y = scaled()
    distance = lambda p, a, b: p["amplitude"] ** 2 * separation(p, a, b)  # 0 on the diagonal
    gp = fit_kernel(distance, Z, y, *box(), noise=(1e-3, 1e-2), key=KEY)
    assert gp.result == RESULTS.not_positive_definite and not np.isfinite(gp.log_marginal_likelihood)


def test_few_steps_and_bad_data_are_reported():
    Z, y = scaled()
    assert fitted(squared_exponential, Z, y, max_steps=2).result == RESULTS.not_converged
    y[0] = np.nan
    assert fitted(squared_exponential, Z, y).result == RESULTS.non_finite
