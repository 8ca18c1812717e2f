"""Algorithm 1 against cases worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np

from driftjax.explore import select
from driftjax.gp import Hyper, condition, data_scales

P = jnp.array([1.0, 2.0, 3.0])
CANDIDATES = jnp.array([[10.0, 7e3], [10.5, 7e3], [12.0, 7e3], [14.0, 7e3]])
Z_REF = jnp.array([10.0, 7e3])


def learnt(rows):
    """A GP of two inputs and three outputs that has seen speeds around 10 m/s."""
    Z = jnp.stack([jnp.linspace(8.0, 11.0, rows), 7e3 + 2e3 * jnp.sin(jnp.arange(rows))], axis=1)
    Y, mask = jnp.stack([Z[:, 0], Z[:, 0] ** 2, jnp.ones(rows)], axis=1), jnp.ones(rows, bool)
    hyper = Hyper(jnp.log(jnp.array([[0.5, 2.0], [1.0, 2.0], [2.0, 2.0]])), jnp.zeros(3), jnp.full(3, -3.0))
    return condition(Z, Y, mask, hyper, *data_scales(Z, Y, mask), "se")


GP = learnt(20)
NONE = jnp.zeros(4, bool)


def test_scores_are_the_formula():
    out = select(CANDIDATES, NONE, Z_REF, GP, P, 0.3)
    D = np.array([np.linalg.norm((z - Z_REF) / GP.scale) for z in CANDIDATES])
    V = np.array([sum(P[i] * GP.variance(z)[i] / GP.prior_variance[i] for i in range(3)) for z in CANDIDATES])
    np.testing.assert_allclose(out.score, 0.3 * V / V.max() - 0.7 * D / D.max(), rtol=1e-12)
    np.testing.assert_allclose(out.distance, np.array([0.0, 0.5, 2.0, 4.0]) / 4.0, atol=1e-12)


def test_only_variance_goes_far_and_only_distance_stays_near():
    assert select(CANDIDATES, NONE, Z_REF, GP, P, 1.0).candidate == 3
    assert select(CANDIDATES, NONE, Z_REF, GP, P, 0.0).candidate == 0


def test_each_candidate_is_visited_once_then_all_are_exhausted():
    visited, order = NONE, []
    for _ in range(4):
        out = select(CANDIDATES, visited, Z_REF, GP, P, 0.6)
        assert not out.exhausted and not visited[out.candidate] and out.score[out.candidate] == jnp.max(out.score)
        order.append(int(out.candidate))
        visited = visited.at[out.candidate].set(True)
    assert sorted(order) == [0, 1, 2, 3]
    assert select(CANDIDATES, visited, Z_REF, GP, P, 0.6).exhausted


def test_units_of_the_inputs_do_not_matter():
    kilo = jnp.array([1.0, 1e-3])
    Z = GP.Z * kilo
    Y = jnp.stack([GP.Z[:, 0], GP.Z[:, 0] ** 2, jnp.ones(20)], axis=1)
    rescaled = condition(Z, Y, GP.mask, GP.hyper, *data_scales(Z, Y, GP.mask), "se")
    ours = select(CANDIDATES * kilo, NONE, Z_REF * kilo, rescaled, P, 0.5)
    np.testing.assert_allclose(ours.score, select(CANDIDATES, NONE, Z_REF, GP, P, 0.5).score, rtol=1e-9, atol=1e-12)


def test_a_candidate_at_the_reference_alone_has_distance_zero():
    out = select(CANDIDATES[:1], jnp.zeros(1, bool), Z_REF, GP, P, 0.5)
    assert out.distance[0] == 0 and out.variance[0] == 1 and out.candidate == 0


def test_lanes_equal_single_calls():
    references = jnp.stack([Z_REF, CANDIDATES[2]])
    visited = jnp.stack([NONE, NONE.at[2].set(True)])
    batch = jax.vmap(lambda v, z: select(CANDIDATES, v, z, GP, P, 0.5))(visited, references)
    for i in range(2):
        assert batch.candidate[i] == select(CANDIDATES, visited[i], references[i], GP, P, 0.5).candidate
