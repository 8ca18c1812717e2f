"""Solve an optimal control problem of your own: land a rocket with little fuel, from 8 heights at once."""

import jax
import jax.numpy as jnp

import driftjax as dj
from driftjax.solve import AbstractOCP, solve


class Landing(AbstractOCP):
    """State: height and speed upwards; input: thrust over weight; parameter: the largest thrust. Units: l and l / g."""

    def step(self, x, u, p):
        speed = x[1] + 0.1 * (u[0] - 1 - 0.1 * x[1] * jnp.abs(x[1]))
        return jnp.stack([x[0] + 0.1 * speed, speed])

    def cost(self, x, u, p):
        return 0.1 * u[0] ** 2

    def terminal(self, x, p):
        return 100 * (x[0] ** 2 + x[1] ** 2)

    def constraints(self, x, u, p):
        return jnp.stack([u[0], p - u[0], x[0] + 0.01])  # each at least 0


starts = jnp.stack([jnp.linspace(1.0, 4.0, 8), jnp.zeros(8)], axis=1)
limits, X, U = jnp.full(61, 1.8), jnp.linspace(starts, 0 * starts, 61, axis=1), jnp.ones((60, 1))
plan = jax.jit(jax.vmap(lambda x, X: solve(Landing(), x, limits, X, U)))(starts, X)
print("converged:", plan.result == dj.RESULTS.successful, "iterations:", plan.num_steps)
print("height and speed at the end:", plan.X[:, -1].round(3))
print("cost by start:", jax.jit(jax.grad(lambda x: solve(Landing(), x, limits, X[0], U).cost))(starts[0]))
