"""Values that several results share are computed once by the compiled program."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from driftjax.solve.compute_once import compute_once

X = jnp.linspace(0.5, 0.9, 32).reshape(8, 4)


def several(x: jax.Array, y: jax.Array) -> list[jax.Array]:
    """Return results that read one long expression, and an argument that is one outside."""
    shared = functools.reduce(lambda a, b: a * b + x, [x] * 30)
    return [jnp.flip(shared) * 2.0, shared + y, shared - y, y * y]


def counted(function) -> int:
    """Count the multiplications of the program in which the argument `y` is a long expression too."""
    whole = lambda x: function(x, functools.reduce(lambda a, b: a * b + x, [x] * 40))
    text = jax.jit(whole).lower(X).compile().as_text()
    assert text is not None
    return text.count(" multiply(")


def test_the_compiled_program_holds_no_copies():
    work = 29 + 39 + 2
    assert counted(several) > 1.5 * work, "else XLA does this itself now"
    assert counted(compute_once(several)) == work


def test_values_are_those_of_the_function():
    for one, other in zip(compute_once(several)(X, X + 1), several(X, X + 1), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-15)
