"""The dictionary keeps the informative rows, never more than asked, never a masked one."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from driftjax.gp import Hyper, condition, data_scales, select_dictionary

select: Any = eqx.filter_jit(select_dictionary)


def clustered(N=400, seed=0) -> Any:
    """A lap-like record: most rows near one spot, a few along the way to it."""
    rng = np.random.default_rng(seed)
    t = np.where(rng.uniform(size=N) < 0.85, rng.normal(0.0, 0.05, N), rng.uniform(-2, 2, N))
    Z = np.stack([t, 0.5 * t**2 + 0.02 * rng.normal(size=N)], axis=1)
    return Z, np.sin(2 * t)[:, None] + 0.05 * rng.normal(size=(N, 1))


@jax.jit
def means(Z, Y, mask, points):
    hyper = Hyper(jnp.zeros((1, 2)), jnp.zeros(1), jnp.full(1, jnp.log(0.1)))
    scale = data_scales(clustered()[0], Y[:1], jnp.ones(400, bool))[0]
    return jax.vmap(condition(Z, Y, mask, hyper, scale, jnp.ones(1), "se").mean)(points)


def held_out_error(Z, Y, mask):
    t = np.linspace(-1.8, 1.8, 60)
    predicted = np.asarray(means(Z, Y, mask, np.stack([t, 0.5 * t**2], 1)))[:, 0]
    return float(np.sqrt(np.mean((predicted - np.sin(2 * t)) ** 2)))


def test_dictionary_beats_random_rows_of_the_same_number():
    Z, Y = clustered()
    kept = held_out_error(*select(Z, Y, np.ones(400, bool), 15))
    random = []
    for seed in range(5):
        rows = np.random.default_rng(seed).choice(400, 15, replace=False)
        random.append(held_out_error(Z[rows], Y[rows], np.ones(15, bool)))
    assert kept < min(random)


def test_limit_and_mask_are_respected():
    Z, Y = clustered()
    mask = np.arange(400) % 3 == 0
    Z_M, Y_M, mask_M = select(np.where(np.arange(400)[:, None] == 1, np.nan, Z), Y, mask, 20)
    assert Z_M.shape == (20, 2) and Y_M.shape == (20, 1) and np.all(mask_M)
    allowed = Z[mask]
    rows = [int(np.argmin(np.sum((allowed - z) ** 2, axis=1))) for z in np.asarray(Z_M)]
    assert len(set(rows)) == 20
    np.testing.assert_array_equal(allowed[rows], Z_M)
    np.testing.assert_array_equal(Y[mask][rows], Y_M)


def test_fewer_rows_than_the_limit_are_all_kept():
    Z, Y = clustered(10)
    Z_M, _, mask_M = map(np.asarray, select(Z, Y, np.arange(10) < 7, 12))
    assert mask_M.sum() == 7
    np.testing.assert_allclose(np.sort(Z_M[mask_M][:, 0]), np.sort(Z[:7][:, 0]))


def test_a_batch_equals_single_calls():
    data = [clustered(seed=seed) for seed in (1, 2)]
    Z, Y = (np.stack(parts) for parts in zip(*data, strict=True))
    mask = np.ones((2, 400), bool)
    batch = jax.jit(jax.vmap(lambda Z, Y, mask: select_dictionary(Z, Y, mask, 15)[0]))(Z, Y, mask)
    for entry in range(2):
        np.testing.assert_allclose(batch[entry], select(Z[entry], Y[entry], mask[entry], 15)[0])
