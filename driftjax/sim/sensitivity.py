"""Compute the derivatives of one step by state, input and every parameter at once.

The forces have few outputs and few inputs that change within a step, but some sixty parameters. Their Jacobian is
therefore computed in reverse mode at each Runge-Kutta stage, and only small products are propagated forwards.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.core import State
from driftjax.core.integrate import RK4_INTO, RK4_WEIGHTS
from driftjax.sim.step import (
    LaggedState,
    StepStart,
    begin_step,
    hold_of,
    hold_segment,
    lag_offsets,
    lagged_after,
    midpoints,
)
from driftjax.vehicle.effect.flow import Place, rates
from driftjax.vehicle.universal import Universal


class Dual(NamedTuple):
    """Values (k,) and their derivatives (k, M) by M variables."""

    value: Array
    by: Array


def join(*parts: Dual) -> Dual:
    """Concatenate duals."""
    return Dual(*(jnp.concatenate(columns) for columns in zip(*parts, strict=True)))


def through(f, x: Dual, theta: Array) -> Dual:
    """Apply f(x, theta): chain the derivatives of `x`; theta (K,) is the last K of the variables."""
    by_x, by_theta = jax.jacrev(f, (0, 1))(x.value, theta)
    return Dual(f(x.value, theta), (by_x @ x.by).at[:, x.by.shape[1] - len(theta) :].add(by_theta))


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

    def at_start(v):
        return StepStart(State(*v[:3]), LaggedState(v[3:5], v[5]), hold_of(v[6:10]), v[10:12], v[12])

    def start(v, theta):
        x, lagged, hold, *_ = at_start(v)
        found = begin_step(model.with_parameters(theta), x, lagged, hold, place, dt, State(*v[10:13]))
        return jnp.concatenate([found.slip_rate, found.ay[None]])

    def force(v, theta, share):
        car, at, y = model.with_parameters(theta), at_start(v), State(*v[13:])
        return jnp.stack(rates(car.flow(y, at.hold.at(share), place, lag_offsets(car, at, y, share, dt))))

    def reach(v, theta):
        lagged = lagged_after(model.with_parameters(theta), at_start(v), State(*v[13:]), dt)
        return jnp.concatenate([v[13:], lagged.slip, lagged.ay[None]])

    began = join(z, inputs)
    began = join(began, through(start, join(began, push), model.theta))
    state = jax.tree.map(lambda a: a[:3], z)

    def stage(carry, row):
        k, total = carry
        node, weight = row
        y = jax.tree.map(lambda a, b: a + node * dt * b, state, k)
        found = through(lambda v, theta: force(v, theta, node), join(began, y), model.theta)
        k = jax.tree.map(jnp.add, found, push)
        return (k, jax.tree.map(lambda a, b: a + weight * dt * b, total, k)), None

    nothing = jax.tree.map(jnp.zeros_like, state)
    (_, after), _ = jax.lax.scan(stage, (nothing, state), (jnp.asarray(RK4_INTO), jnp.asarray(RK4_WEIGHTS)))
    return through(reach, join(began, after), model.theta)
