"""The dictionary keeps the informative rows, never more than asked, never a masked one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.gp import Hyper, condition, data_scales, select_dictionary


def clustered(N=400, seed=0):
    """A lap-like record: most rows near one spot, a few along the way to it."""
    rng = np.random.default_rng(seed)
    t = np.where(rng.uniform(size=N) < 0.85, rng.normal(0.0, 0.05, N), rng.uniform(-2, 2, N))
    Z = np.stack([t, 0.5 * t**2 + 0.02 * rng.normal(size=N)], axis=1)
    return jnp.asarray(Z), jnp.asarray(np.sin(2 * t)[:, None] + 0.05 * rng.normal(size=(N, 1)))


def held_out_error(Z, Y, mask):
    hyper = Hyper(jnp.zeros((1, 2)), jnp.zeros(1), jnp.full(1, jnp.log(0.1)))
    gp = condition(Z, Y, mask, hyper, data_scales(*clustered()[:1], Y[:1], jnp.ones(400, bool))[0], jnp.ones(1), "se")
    t = jnp.linspace(-1.8, 1.8, 60)
    truth = jnp.sin(2 * t)
    return float(jnp.sqrt(jnp.mean((jax.vmap(gp.mean)(jnp.stack([t, 0.5 * t**2], 1))[:, 0] - truth) ** 2)))


def test_dictionary_beats_random_rows_of_the_same_number():
    Z, Y = clustered()
    kept = held_out_error(*select_dictionary(Z, Y, jnp.ones(400, bool), 15))
    random = []
    for seed in range(5):
        rows = np.random.default_rng(seed).choice(400, 15, replace=False)
        random.append(held_out_error(Z[rows], Y[rows], jnp.ones(15, bool)))
    assert kept < min(random)


def test_limit_and_mask_are_respected():
    Z, Y = clustered()
    mask = jnp.arange(400) % 3 == 0
    Z_M, Y_M, mask_M = select_dictionary(Z.at[1].set(jnp.nan), Y, mask, 20)
    assert Z_M.shape == (20, 2) and Y_M.shape == (20, 1) and bool(jnp.all(mask_M))
    allowed = np.asarray(Z[mask])
    rows = [int(np.argmin(np.sum((allowed - z) ** 2, axis=1))) for z in np.asarray(Z_M)]
    assert len(set(rows)) == 20
    np.testing.assert_array_equal(allowed[rows], Z_M)
    np.testing.assert_array_equal(np.asarray(Y[mask])[rows], Y_M)


def test_fewer_rows_than_the_limit_are_all_kept():
    Z, Y = clustered(10)
    Z_M, _, mask_M = select_dictionary(Z, Y, jnp.arange(10) < 7, 12)
    assert int(mask_M.sum()) == 7
    np.testing.assert_allclose(np.sort(np.asarray(Z_M[mask_M])[:, 0]), np.sort(np.asarray(Z[:7])[:, 0]))


def test_lanes_equal_single_calls():
    data = [clustered(seed=seed) for seed in (1, 2)]
    Z, Y = (jnp.stack(parts) for parts in zip(*data, strict=True))
    mask = jnp.ones((2, 400), bool)
    batch = eqx.filter_vmap(lambda Z, Y, mask: select_dictionary(Z, Y, mask, 15)[0])(Z, Y, mask)
    for lane in range(2):
        np.testing.assert_allclose(batch[lane], select_dictionary(Z[lane], Y[lane], mask[lane], 15)[0])
