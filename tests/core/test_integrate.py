"""Orders of convergence of the fixed-step integrators, and the first-order lag against its closed form."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from driftjax.core import lag_step, rk4_loop, rk4_step
from driftjax.core.integrate import HEUN, RK4, axpy


@functools.partial(jax.jit, static_argnums=0)
def pendulum(step, num):
    """Angle and rate at t = 2 s of a driven pendulum, in `num` steps; time is part of the state."""
    rate = lambda x: {"angle": x["rate"], "rate": -jnp.sin(x["angle"]) + 0.5 * jnp.cos(x["t"]), "t": jnp.ones(())}
    x = {"angle": jnp.asarray(1.0), "rate": jnp.zeros(()), "t": jnp.zeros(())}
    x = jax.lax.fori_loop(0, num, lambda _, x: step(rate, x, 2.0 / num), x)
    return jnp.stack([x["angle"], x["rate"]])


def explicit(method):
    """The step of a tableau."""

    def step(f, x, dt):
        k, end = jax.tree.map(jnp.zeros_like, x), x
        for into, weight in zip(*method, strict=True):
            k = f(axpy(dt * into, k, x))
            end = axpy(dt * weight, k, end)
        return end

    return step


@pytest.mark.parametrize(
    ("step", "order"), [(explicit(HEUN), 2), (explicit(RK4), 4), (rk4_step, 4)], ids=["heun", "rk4", "step"]
)
def test_order_of_convergence(step, order):
    exact = np.asarray(pendulum(rk4_step, 1000))
    errors = [np.abs(np.asarray(pendulum(step, num)) - exact).max() for num in (10, 20, 40)]
    assert errors[-1] > 1e-9  # well above rounding, or the order says nothing
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, atol=0.35)


def test_the_loop_is_the_same_step_with_the_same_derivatives():
    rate = lambda x: jnp.stack([x[1], -jnp.sin(x[0]) * x[0] * x[1], x[0] * x[2]])
    bent = lambda x: rk4_step(rate, x, 0.3) @ jnp.arange(1.0, 4.0)
    moved = lambda x: rk4_loop(lambda x, _: rate(x), x, 0.3) @ jnp.arange(1.0, 4.0)
    x = jnp.asarray([0.4, -0.7, 1.1])
    for take in (lambda f: f, jax.grad, jax.jacfwd, jax.hessian):
        np.testing.assert_allclose(jax.jit(take(moved))(x), jax.jit(take(bent))(x), rtol=1e-12, atol=1e-14)


def test_the_loop_passes_each_slope_its_own_row():
    times = 2.0 + 0.1 * np.array([0.0, 0.5, 0.5, 1.0])  # x_dot = t^3: Simpson's rule, exact
    end = jax.jit(lambda times: rk4_loop(lambda x, t: jnp.stack([t**3]), jnp.zeros(1), 0.1, times))(times)
    np.testing.assert_allclose(end, (2.1**4 - 2.0**4) / 4, rtol=1e-13)


@pytest.mark.parametrize("lag", [0.003, 0.08, 2.0])
def test_lag_is_that_of_the_differential_equation(lag):
    dt, start, target = 0.05, 0.4, -1.2
    t = np.linspace(0, dt, 20001)
    course = target + (start - target) * np.exp(-t / lag)
    mean, end = jax.jit(lag_step)(*map(jnp.asarray, (start, target, lag, dt)))
    np.testing.assert_allclose(mean, np.trapezoid(course, t) / dt, atol=1e-6)
    np.testing.assert_allclose(end, course[-1], atol=1e-14)


def test_no_lag_is_the_target_with_the_slope_of_a_small_one():
    dt, start, target = 0.05, 0.4, -1.2
    step = jax.jit(lambda lag: jnp.stack(lag_step(jnp.asarray(start), jnp.asarray(target), lag, jnp.asarray(dt))))
    np.testing.assert_array_equal(step(0.0), target)
    slope = jax.jit(jax.jacfwd(step))(0.0)
    small = (np.asarray(step(1e-4)) - target) / 1e-4
    np.testing.assert_allclose(slope, small, rtol=1e-9, atol=1e-12)
