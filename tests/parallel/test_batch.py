"""A function of every entry: one alone takes one branch only, several give the same."""

import jax
import jax.numpy as jnp
import numpy as np

from driftjax.parallel import vmap_batch


def ran(entry: tuple, name: str) -> tuple:
    x, key = entry
    turned = jax.lax.cond(x > 0, lambda: jnp.cosh(x), lambda: x - 1)
    return turned + jax.random.uniform(key), {"name": name, "x": x}


def test_an_entry_gives_alone_what_it_gives_among_others():
    x, keys = jnp.asarray([0.5, -0.5]), jax.random.split(jax.random.key(1), 2)
    run = vmap_batch(lambda x, key: ran((x, key), "car"))
    both = run(x, keys)
    for i in range(2):
        one = run(x[i : i + 1], keys[i : i + 1])
        assert one[1]["name"] == "car" and one[0].shape == (1,)
        np.testing.assert_array_equal(one[0], both[0][i : i + 1])


def test_one_entry_keeps_its_branches():
    program = lambda num: str(
        jax.make_jaxpr(vmap_batch(lambda x: jax.lax.cond(x > 0, jnp.cosh, jnp.sinh, x)))(jnp.ones(num))
    )
    assert " cond[" in program(1) and " cond[" not in program(2)
