"""Compute the derivatives of one step by state, input and every parameter at once.

A substep has six outputs, but some sixty parameters: its Jacobian is computed in reverse mode, and only products with
the few variables that substeps pass on are propagated forwards.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import State
from driftjax.sim.step import LaggedState, hold_of, hold_segment, lagged_step, midpoints
from driftjax.vehicle.effect.flow import Place
from driftjax.vehicle.universal import Universal


class Dual(NamedTuple):
    """Values (k,) and their derivatives (k, M) by M variables."""

    value: Array
    by: Array


def move_with_derivatives(
    model: Universal, z: Float[Array, "6"], u: Float[Array, "4"], place: Place, dt: Array, push: Float[Array, "3"]
) -> Dual:
    """Return state and lagged state one step later (6,), and its derivatives (6, 13 + K) by z, u, push and theta.

    The same step as `rollout.move`; `push` is added to the rates.
    """
    every, num = jnp.eye(13, 13 + len(model.theta)), model.substeps
    pushed = Dual(push, every[10:13])

    def on(z, middle):
        inputs = Dual(hold_segment(u, middle, num), hold_segment(every[6:10], middle, num))
        return substep(model, z, inputs, place, dt / num, pushed), None

    start = Dual(z, every[:6])
    if num == 1:
        return on(start, 0.0)[0]
    return jax.lax.scan(on, start, midpoints(num))[0]


def substep(model: Universal, z: Dual, inputs: Dual, place: Place, dt: Array, push: Dual) -> Dual:
    """Return state and lagged state (6,) one substep after `z`, under `inputs` (4,), rates `push` (3,) added."""

    def after(z, u, push, theta):
        car, x, lagged = model.with_parameters(theta), State(*z[:3]), LaggedState(z[3:5], z[5])
        x, lagged, *_ = lagged_step(car, x, lagged, hold_of(u), place, dt, State(*push))
        return jnp.concatenate([jnp.stack(x), lagged.slip, lagged.ay[None]])

    value, pull = jax.vjp(after, z.value, inputs.value, push.value, model.theta)
    by_z, by_u, by_push, by_theta = jax.vmap(pull)(jnp.eye(len(value)))
    by = by_z @ z.by + by_u @ inputs.by + by_push @ push.by
    return Dual(value, by.at[:, by.shape[1] - len(model.theta) :].add(by_theta))
