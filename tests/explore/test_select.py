"""Algorithm 1 against cases worked out by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from driftjax import explore
from driftjax.gp import Hyper, condition, data_scales

P: Any = np.array([1.0, 2.0, 3.0])
CANDIDATES: Any = np.array([[10.0, 7e3], [10.5, 7e3], [12.0, 7e3], [14.0, 7e3]])
Z_REF = np.array([10.0, 7e3])
LENGTH = np.array([[0.5, 2.0], [1.0, 2.0], [2.0, 2.0]])
select = jax.jit(explore.select)


@jax.jit
def fitted_gp(Z, Y):
    """A GP of two inputs and three outputs."""
    mask, hyper = jnp.ones(len(Z), bool), Hyper(jnp.log(LENGTH), jnp.zeros(3), jnp.full(3, -3.0))
    return condition(Z, Y, mask, hyper, *data_scales(Z, Y, mask), "se")


Z = np.stack([np.linspace(8.0, 11.0, 20), 7e3 + 2e3 * np.sin(np.arange(20))], axis=1)  # speeds around 10 m/s
Y = np.stack([Z[:, 0], Z[:, 0] ** 2, np.ones(20)], axis=1)
GP = fitted_gp(Z, Y)
NONE = np.zeros(4, bool)


def test_scores_are_the_formula():
    out = select(CANDIDATES, NONE, Z_REF, GP, P, 0.3)
    D = np.linalg.norm((CANDIDATES - Z_REF) / np.asarray(GP.scale), axis=1)
    variance, prior = jax.jit(lambda gp: (jax.vmap(gp.variance)(CANDIDATES), gp.prior_variance))(GP)
    V = np.sum(P * np.asarray(variance) / np.asarray(prior), axis=1)
    np.testing.assert_allclose(out.score, 0.3 * V / V.max() - 0.7 * D / D.max(), rtol=1e-12)
    np.testing.assert_allclose(out.distance, np.array([0.0, 0.5, 2.0, 4.0]) / 4.0, atol=1e-12)


def test_only_variance_goes_far_and_only_distance_stays_near():
    assert select(CANDIDATES, NONE, Z_REF, GP, P, 1.0).candidate == 3
    assert select(CANDIDATES, NONE, Z_REF, GP, P, 0.0).candidate == 0


def test_each_candidate_is_visited_once_then_all_are_exhausted():
    visited, order = NONE.copy(), []
    for _ in range(4):
        out = jax.device_get(select(CANDIDATES, visited, Z_REF, GP, P, 0.6))
        assert not out.exhausted and not visited[out.candidate] and out.score[out.candidate] == np.max(out.score)
        order.append(int(out.candidate))
        visited[out.candidate] = True
    assert sorted(order) == [0, 1, 2, 3]
    assert select(CANDIDATES, visited, Z_REF, GP, P, 0.6).exhausted


def test_units_of_the_inputs_do_not_matter():
    kilo = np.array([1.0, 1e-3])
    rescaled = fitted_gp(Z * kilo, Y)
    ours = select(CANDIDATES * kilo, NONE, Z_REF * kilo, rescaled, P, 0.5)
    np.testing.assert_allclose(ours.score, select(CANDIDATES, NONE, Z_REF, GP, P, 0.5).score, rtol=1e-9, atol=1e-12)


def test_a_candidate_at_the_reference_alone_has_distance_zero():
    out = select(CANDIDATES[:1], np.zeros(1, bool), Z_REF, GP, P, 0.5)
    assert out.distance[0] == 0 and out.variance[0] == 1 and out.candidate == 0


def test_a_batch_equals_single_calls():
    references = np.stack([Z_REF, CANDIDATES[2]])
    visited = np.stack([NONE, np.arange(4) == 2])
    batch = jax.jit(jax.vmap(lambda v, z: explore.select(CANDIDATES, v, z, GP, P, 0.5)))(visited, references)
    for i in range(2):
        assert batch.candidate[i] == select(CANDIDATES, visited[i], references[i], GP, P, 0.5).candidate
