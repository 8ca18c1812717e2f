"""The fit against scikit-learn's with restarts, and its failure and batching behaviour."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gp_data import smooth
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from driftjax.core import RESULTS
from driftjax.gp import fit_masked
from driftjax.gp.fit import LOWER, UPPER

KEY = jax.random.key(0)
N = 40


def padded(n, seed, noise=0.05) -> Any:
    Z, Y = smooth(N, seed=seed, noise=noise)
    return Z, Y, np.arange(N) < n


at = eqx.filter_jit(lambda f, points: jax.vmap(f)(points))


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.parametrize(("seed", "noise"), [(0, 0.05), (1, 0.3), (2, 0.01)])
def test_likelihood_is_at_least_scikit_learns(seed, noise):
    Z, Y, mask = padded(N, seed, noise)
    ours = fit_masked(Z, Y, mask, max_iterations=60, key=KEY)
    box = [(low**power, high**power) for low, high, power in zip(LOWER, UPPER, (1, 2, 2), strict=True)]
    for d in range(2):
        lengths: Any = np.ones(3)
        kernel = ConstantKernel(1.0, box[1]) * RBF(lengths, box[0]) + WhiteKernel(0.01, box[2])
        other: Any = GaussianProcessRegressor(kernel, alpha=0, n_restarts_optimizer=3, random_state=0)
        other.fit(Z / np.asarray(ours.gp.scale), Y[:, d] / float(ours.gp.output_scale[d]))
        assert ours.log_marginal_likelihood[d] > other.log_marginal_likelihood_value_ - 0.05
    assert np.all(np.asarray(ours.error) < 1e-2)


def test_padding_changes_nothing():
    Z, Y, mask = padded(25, 4)
    with_padding = fit_masked(Z, Y, mask, max_iterations=60, key=KEY)
    without = fit_masked(Z[:25], Y[:25], mask[:25], max_iterations=60, key=KEY)
    np.testing.assert_allclose(with_padding.log_marginal_likelihood, without.log_marginal_likelihood, rtol=1e-6)
    np.testing.assert_allclose(at(with_padding.gp.mean, Z[3:4]), at(without.gp.mean, Z[3:4]), rtol=1e-4)


def test_a_batch_equals_single_fits_and_shares_one_compile():
    traces = []

    @eqx.filter_jit
    def fit_batch(Z, Y, mask, keys):
        traces.append(1)
        return eqx.filter_vmap(lambda Z, Y, mask, key: fit_masked(Z, Y, mask, max_iterations=60, key=key))(
            Z, Y, mask, keys
        )

    for n in (30, 38):
        data = [padded(n, seed) for seed in (5, 6)]
        Z, Y, mask = (np.stack(parts) for parts in zip(*data, strict=True))
        batch = fit_batch(Z, Y, mask, jnp.stack([KEY, KEY]))
        assert jnp.all(batch.result == RESULTS.successful)
    assert len(traces) == 1
    for entry, (Z, Y, mask) in enumerate(data):
        single = fit_masked(Z, Y, mask, max_iterations=60, key=KEY)
        np.testing.assert_allclose(batch.log_marginal_likelihood[entry], single.log_marginal_likelihood, rtol=1e-6)


def test_held_out_targets_are_predicted_with_honest_variance():
    Z, Y, mask = padded(N, 7)
    gp = fit_masked(Z, Y, mask, max_iterations=60, key=KEY).gp
    points, truth = smooth(200, seed=70, noise=0.0)
    error = np.asarray(at(gp.mean, points)) - truth
    sigma = np.sqrt(at(gp.variance, points))
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 0.25 * np.asarray(gp.output_scale))
    covered = np.mean(np.abs(error) < 2 * sigma, axis=0)
    assert np.all(covered > 0.75)


def test_no_data_and_bad_data_are_distinguished():
    Z, Y, mask = padded(0, 0)
    empty = fit_masked(Z, Y, mask, max_iterations=60, key=KEY)
    assert np.all(np.asarray(at(empty.gp.mean, Z[:1])) == 0) and jnp.all(empty.result == RESULTS.successful)
    Y[0, 0], mask[:5] = np.nan, True
    broken = fit_masked(Z, Y, mask, max_iterations=60, key=KEY)
    assert bool((broken.result == RESULTS.non_finite)[0])


def test_a_subset_fits_the_hyper_parameters_and_all_rows_condition():
    Z, Y, mask = padded(N, 9)
    result = fit_masked(Z, Y, mask, max_iterations=60, num_fit=30, key=KEY)
    full = fit_masked(Z, Y, mask, max_iterations=60, key=KEY)
    assert np.all(np.abs(result.gp.alpha) > 0)
    assert np.all(np.isfinite(result.log_marginal_likelihood))
    difference = np.asarray(at(result.gp.mean, Z)) - at(full.gp.mean, Z)
    assert np.max(np.abs(difference) / np.asarray(full.gp.output_scale)) < 0.5


def test_a_previous_fit_saves_iterations():
    Z, Y, mask = padded(N, 10)
    cold = fit_masked(Z, Y, mask, max_iterations=60, key=KEY)
    warm = fit_masked(Z, Y, mask, max_iterations=60, previous=cold.gp, key=KEY)
    assert np.all(np.asarray(warm.num_steps) < cold.num_steps)
