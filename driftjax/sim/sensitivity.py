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
from driftjax.core.integrate import RK4
from driftjax.sim.step import (
    LaggedState,
    StepStart,
    evaluate,
    evaluations,
    first_slip_rate,
    hold_of,
    hold_segment,
    lagged_after,
    midpoints,
)
from driftjax.vehicle.effect.flow import Place
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
    value, pull = jax.vjp(f, x.value, theta)
    by_x, by_theta = jax.vmap(pull)(jnp.eye(len(value)))
    return Dual(value, (by_x @ x.by).at[:, x.by.shape[1] - len(theta) :].add(by_theta))


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

    def begun(v):
        return StepStart(State(*v[:3]), LaggedState(v[3:5], v[5]), hold_of(v[6:10]), v[13:15], v[15])

    def rates(v, theta, share, first):
        return evaluate(model.with_parameters(theta), begun(v), v[16:], share, first, place, dt, v[10:13])

    def slip(v, theta):
        return first_slip_rate(model.with_parameters(theta), begun(v), v[16:], dt)

    def reach(v, theta):
        lagged = lagged_after(model.with_parameters(theta), begun(v), State(*v[16:]), dt)
        return jnp.concatenate([v[16:], lagged.slip, lagged.ay[None]])

    began, start = join(z, inputs, push), _rows(z, slice(3))
    nothing = jax.tree.map(jnp.zeros_like, start)
    either = lambda first, a, b: jax.tree.map(lambda a, b: jnp.where(first, a, b), a, b)

    def on(carry, row):  # as in `lagged_step`
        k, end, known = carry
        first, into, weight = row
        y = jax.tree.map(lambda a, b: a + into * dt * b, start, k)
        derivative = through(lambda v, theta: rates(v, theta, into, first), join(began, known, y), model.theta)
        dx, ay = _rows(derivative, slice(3)), _rows(derivative, slice(3, 4))
        moving = through(slip, join(began, known, dx), model.theta)
        k, known = either(first, k, dx), either(first, join(moving, ay), known)
        return (k, jax.tree.map(lambda a, b: a + weight * dt * b, end, k), known), None

    (_, end, known), _ = jax.lax.scan(on, (nothing, start, nothing), evaluations(RK4, start.value.dtype))
    return through(reach, join(began, known, end), model.theta)


def _rows(x: Dual, which: slice) -> Dual:
    return jax.tree.map(lambda a: a[which], x)
