"""Canaries: what this package uses of JAX beyond its stable API. A failure here names the release that changed it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import elementary
from driftjax.solve.component_derivatives import jacobian
from driftjax.solve.compute_once import compute_once

X = jnp.linspace(0.1, 0.9, elementary.MIN_VECTOR_SIZE)


def helped(x):
    """Calls of every kind that `compute_once` opens: jit, custom_jvp and custom_vjp."""
    rule = jax.custom_vjp(lambda x: x * x)
    rule.defvjp(lambda x: (x * x, x), lambda x, g: (2 * x * g,))
    return jax.jit(jnp.sin)(x) + jax.nn.relu(x) + rule(x)


def primitives():
    """`elementary` defines primitives: jax.extend.core.Primitive and jax.interpreters.{ad,batching,mlir}."""
    value, slope = jax.jit(
        jax.vmap(jax.value_and_grad(lambda x: elementary.sin(x * jnp.ones(elementary.MIN_VECTOR_SIZE))[0]))
    )(X)
    np.testing.assert_allclose(value, np.sin(X), rtol=1e-14)
    np.testing.assert_allclose(slope, np.cos(X), rtol=1e-14)


def opened_calls():
    """`compute_once` evaluates a jaxpr, opens calls by the names of their primitives and sets barriers."""
    names = lambda f: [eqn.primitive.name for eqn in jax.make_jaxpr(f)(X).jaxpr.eqns]
    assert {"jit", "pjit"} & set(names(helped))  # else there is nothing to open
    assert not {"jit", "pjit", "custom_jvp_call", "custom_vjp_call"} & set(names(compute_once(helped)))
    assert "optimization_barrier" in names(compute_once(lambda x: jnp.exp(jnp.sin(x)) * jnp.sin(x)))
    np.testing.assert_array_equal(compute_once(helped)(X), helped(X))


def known_primitives():
    """`sparse` differentiates a jaxpr by the names of its primitives."""
    rates = lambda x, y: [jnp.where(y > 0, jnp.sin(x) * y, jnp.tanh(x) / y), jnp.sqrt(x**2 + y**2), jnp.arctan2(y, x)]
    _, J = jacobian(rates, X, X + 1.0)
    exact = jax.vmap(jax.jacfwd(lambda z: jnp.stack(rates(*z))))(jnp.stack([X, X + 1.0], axis=1))
    values = np.array([[np.zeros(len(X)) if entry is None else entry for entry in row] for row in J])
    np.testing.assert_allclose(values, np.moveaxis(exact, 0, -1), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("canary", [primitives, opened_calls, known_primitives], ids=lambda one: one.__name__)
def test_this_release_of_jax_has_the_internals_that_are_used(canary):
    try:
        canary()
    except Exception as error:
        raise AssertionError(f"JAX {jax.__version__} changed what is used of it. {canary.__doc__} {error!r}") from error
