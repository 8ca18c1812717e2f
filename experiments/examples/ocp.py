"""Solve an optimal control problem of your own: land a rocket with little fuel, from 8 heights at once."""

import jax
import jax.numpy as jnp

import driftjax as dj
from driftjax.solve import AbstractOCP, solve


class Landing(AbstractOCP):
    """State: height and speed upwards; input: thrust over weight; parameter: the largest thrust. Units: l and l / g."""

    def step(self, x, u, p):
        return x + 0.1 * jnp.stack([x[1], u[0] - 1 - 0.1 * x[1] * jnp.abs(x[1])])

    def cost(self, x, u, p):
        return 0.1 * u[0] ** 2

    def terminal(self, x, p):
        return 100 * (x[0] ** 2 + x[1] ** 2)

    def constraints(self, x, u, p):
        return jnp.stack([u[0], p - u[0], x[0] + 0.01])  # each at least 0


landing = jax.jit(lambda x: solve(Landing(), x, jnp.full(61, 1.8), jnp.linspace(x, 0 * x, 61), jnp.ones((60, 1))))
plan = jax.vmap(landing)(jnp.stack([jnp.linspace(1.0, 4.0, 8), jnp.zeros(8)], axis=1))
print(plan.result == dj.RESULTS.successful, "cost by start:", jax.grad(lambda x: landing(x).cost)(plan.X[0, 0]))
