"""Derivatives of one step by state, input and every parameter at once.

The forces have few outputs and few inputs that change within a step, but some sixty parameters. So their Jacobian is
had backwards at each stage of the Runge-Kutta step, and only small products run forwards.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import State
from driftjax.sim.step import Begun, Felt, acts_of, begin_step, felt_after, lagging, middles, part
from driftjax.vehicle.effect.flow import Place, rates
from driftjax.vehicle.universal import Universal

NODES, WEIGHTS = np.array([0.0, 0.5, 0.5, 1.0]), np.array([1.0, 2.0, 2.0, 1.0]) / 6  # of the classical Runge-Kutta


class Dual(NamedTuple):
    """Values (k,) and their derivatives (k, M) by the M things that are varied."""

    value: Array
    by: Array


def join(*parts: Dual) -> Dual:
    """Values one after the other."""
    return Dual(*(jnp.concatenate(columns) for columns in zip(*parts, strict=True)))


def through(f, x: Dual, theta: Array, direct: Array) -> Dual:
    """f(x, theta): derivatives by `x` through its own, and by theta where `direct` (K, M) says how it varies."""
    by_x, by_theta = jax.jacrev(f, (0, 1))(x.value, theta)
    return Dual(f(x.value, theta), by_x @ x.by + by_theta @ direct)


def move_with_derivatives(
    model: Universal, z: Float[Array, "6"], u: Float[Array, "4"], place: Place, dt: Array, push: Float[Array, "3"]
) -> Dual:
    """State and what is felt one step later (6,), and its derivatives (6, 13 + K) by z, u, push and theta.

    The same step as `rollout.move`; `push` is added to the rates.
    """
    every, num = jnp.eye(13 + len(model.theta)), model.substeps
    pushed, direct = Dual(push, every[10:13]), every[13:]

    def on(z, middle):
        inputs = Dual(part(u, middle, num), part(every[6:10], middle, num))
        return substep(model, z, inputs, place, dt / num, pushed, direct), None

    start = Dual(z, every[:6])
    if num == 1:
        return on(start, 0.0)[0]
    return jax.lax.scan(on, start, middles(num))[0]


def substep(model: Universal, z: Dual, inputs: Dual, place: Place, dt: Array, push: Dual, direct: Array) -> Dual:
    """State and what is felt (6,) one substep after `z`, under `inputs` (4,), with `push` (3,) added to the rates."""

    def begun(v):
        return Begun(State(*v[:3]), Felt(v[3:5], v[5]), acts_of(v[6:10]), v[10:12], v[12])

    def start(v, theta):
        x, felt, acts, *_ = begun(v)
        found = begin_step(model.with_parameters(theta), x, felt, acts, place, dt, State(*v[10:13]))
        return jnp.concatenate([found.slip_rate, found.ay[None]])

    def force(v, theta, share):
        car, at, y = model.with_parameters(theta), begun(v), State(*v[13:])
        return jnp.stack(rates(car.flow(y, at.acts.at(share), place, lagging(car, at, y, share, dt))))

    def reach(v, theta):
        felt = felt_after(model.with_parameters(theta), begun(v), State(*v[13:]), dt)
        return jnp.concatenate([v[13:], felt.slip, felt.ay[None]])

    began = join(z, inputs)
    began = join(began, through(start, join(began, push), model.theta, direct))
    state = jax.tree.map(lambda a: a[:3], z)

    def stage(carry, row):
        k, total = carry
        node, weight = row
        y = jax.tree.map(lambda a, b: a + node * dt * b, state, k)
        found = through(lambda v, theta: force(v, theta, node), join(began, y), model.theta, direct)
        k = jax.tree.map(jnp.add, found, push)
        return (k, jax.tree.map(lambda a, b: a + weight * dt * b, total, k)), None

    nothing = jax.tree.map(jnp.zeros_like, state)
    (_, after), _ = jax.lax.scan(stage, (nothing, state), (jnp.asarray(NODES), jnp.asarray(WEIGHTS)))
    return through(reach, join(began, after), model.theta, direct)
