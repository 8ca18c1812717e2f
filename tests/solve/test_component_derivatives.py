"""Derivatives by components against JAX's own, zeros kept apart, values computed once."""

import jax
import jax.numpy as jnp
import numpy as np

from driftjax.core import Control, State, rk4_step
from driftjax.solve.component_derivatives import jacobian, midpoint_curvature, runge_kutta, runge_kutta_curvature
from driftjax.solve.compute_once import compute_once
from driftjax.vehicle import load_vehicle

DT = 0.05
Z = [(9.0, 8.2), (-0.5, -0.6), (1.1, 0.9), (-0.3, 0.1), (0.7, 0.5)]


def sliding():
    car = load_vehicle("sedan").build()
    rates = lambda V, beta, r, delta, Fxr: car(State(V, beta, r), Control(delta, 1e4 * Fxr))
    step = lambda v: jnp.stack(rk4_step(lambda x: State(*rates(*x, *v[3:])), State(*v[:3]), DT))
    return rates, step, [jnp.array(z) for z in Z]


def dense(M, entry):
    return np.array([[0.0 if entry is None else value[entry] for value in row] for row in M])


def test_chained_derivatives_of_a_runge_kutta_step_are_those_of_the_whole():
    rates, step, z = sliding()
    y, M = runge_kutta(rates, z[:3], z[3:], DT)
    first = jax.jit(jax.jacfwd(step))
    for entry in range(2):
        v = jnp.array([value[entry] for value in z])
        np.testing.assert_allclose([value[entry] for value in y], step(v), rtol=1e-14)
        np.testing.assert_allclose(dense(M, entry), first(v), atol=1e-13)


def test_second_derivatives_at_the_middle_of_a_step_are_of_second_order():
    """The error of what is proportional to dt falls with its third power; carried through all slopes there is none."""
    rates, _, z = sliding()
    costate = np.array([1.0, -2.0, 0.5])
    pull = [jnp.full(2, c) for c in costate]

    @jax.jit
    def both(dt):
        step = lambda v: jnp.stack(rk4_step(lambda x: State(*rates(*x, *v[3:])), State(*v[:3]), dt))
        exact = jax.vmap(jax.hessian(lambda v: costate @ step(v)))(jnp.stack(z, axis=1))
        middle = midpoint_curvature(rates, z[:3], z[3:], runge_kutta(rates, z[:3], z[3:], dt), dt, pull)
        return middle, runge_kutta_curvature(rates, z[:3], z[3:], dt, pull), exact

    def error(dt):
        H, whole, bent = both(jnp.asarray(dt))
        for entry in range(2):
            np.testing.assert_allclose(dense(whole, entry), bent[entry], atol=1e-13 * np.abs(bent).max())
        return max(np.abs(dense(H, entry) - bent[entry]).max() for entry in range(2)) / np.abs(bent).max()

    assert error(DT) < 0.2
    assert error(DT / 8) < error(DT / 2) / 8  # of first order it would be a quarter


def test_entries_that_cannot_depend_are_none():
    _, J = jacobian(lambda x, y, z: [jnp.sin(x) * y, jnp.where(y > 0, z, -z), y - 2 * x], *jnp.ones((3, 4)))
    assert [[value is None for value in row] for row in J] == [
        [False, False, True],
        [True, True, False],
        [False, False, True],
    ]
    np.testing.assert_allclose(J[0][0], np.cos(1.0) * np.ones(4))
    np.testing.assert_allclose(J[2][0], -2 * np.ones(4))


def test_what_is_used_twice_is_computed_once_and_means_the_same():
    def function(x, y):
        return {"a": jnp.sin(x) * jnp.sin(x) + y, "b": jnp.where(jnp.sin(x) > 0, x, y)}

    x, y = jnp.linspace(-2, 2, 7), jnp.linspace(1, 3, 7)
    program = jax.make_jaxpr(compute_once(function))(x, y)
    names = [eqn.primitive.name for eqn in program.jaxpr.eqns]
    assert names.count("sin") == 1
    assert names.count("optimization_barrier") == 3, "x, y and the sine"
    once, plain = compute_once(function)(x, y), function(x, y)
    np.testing.assert_array_equal(once["a"], plain["a"])
    np.testing.assert_array_equal(once["b"], plain["b"])
