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

from driftjax.core import Control, State
from driftjax.core.integrate import repeated
from driftjax.sim.rollout import Felt, fading, felt_after, follow, lagged
from driftjax.vehicle.effect.flow import Aux, Place, rates
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
    model: Universal, z: Float[Array, "6"], u: Float[Array, "2"], place: Place, dt: Array, push: Float[Array, "3"]
) -> Dual:
    """State and what is felt one step later (6,), and its derivatives (6, 8 + K) by z, u and theta.

    The same step as `rollout.move`; `push` is added to the rates.
    """
    every = jnp.eye(8 + len(model.theta))
    inputs, direct = Dual(u, every[6:8]), every[8:]
    on = lambda z: substep(model, z, inputs, place, dt / model.substeps, push, direct)
    return repeated(on, Dual(z, every[:6]), model.substeps)


def substep(
    model: Universal, z: Dual, inputs: Dual, place: Place, dt: Array, push: Float[Array, "3"], direct: Array
) -> Dual:
    """State and what is felt (6,) one substep after `z`, under `inputs` (2,)."""
    state, felt = (Dual(z.value[part], z.by[part]) for part in (slice(3), slice(3, 6)))

    def force(v, theta):
        flow = model.at(theta).flow(_state(v), _control(v[6:]), place, Aux(v[3:5], v[5]))
        return jnp.stack([*rates(flow), flow.ay])

    def fade(v, theta):
        aux = fading(model.at(theta), _state(v), Felt(v[3:5], v[5]), _control(v[6:]), dt)
        return jnp.concatenate([aux.slip, aux.ay[None]])

    def behind(v, theta):
        car, x, u = model.at(theta), _state(v), _control(v[6:])
        aux, _ = lagged(car, Felt(v[3:5], v[5]), follow(car, x, u, _state(v[8:]), v[11]), dt)
        return jnp.concatenate([aux.slip, aux.ay[None]])

    def reach(v, theta):
        car, x, u, still = model.at(theta), _state(v), _control(v[6:]), State(*jnp.zeros(3))
        at = follow(car, x, u, still, v[8])
        felt = felt_after(car, Felt(v[3:5], v[5]), at, _state(v[9:]), u, dt)
        return jnp.concatenate([v[9:], felt.slip, felt.ay[None]])

    began = join(state, felt, inputs)
    fades = through(fade, began, model.theta, direct)
    there = through(force, join(state, fades, inputs), model.theta, direct)
    aux = through(behind, join(began, there), model.theta, direct)

    def stage(carry, row):
        k, total = carry
        node, weight = row
        y = jax.tree.map(lambda a, b: a + node * dt * b, state, k)
        found = through(force, join(y, aux, inputs), model.theta, direct)
        k = Dual(found.value[:3] + push, found.by[:3])
        return (k, jax.tree.map(lambda a, b: a + weight * dt * b, total, k)), None

    nothing = jax.tree.map(jnp.zeros_like, state)
    (_, after), _ = jax.lax.scan(stage, (nothing, state), (jnp.asarray(NODES), jnp.asarray(WEIGHTS)))
    ay = Dual(there.value[3:], there.by[3:])
    return through(reach, join(began, ay, after), model.theta, direct)


def _state(v: Array) -> State:
    return State(v[0], v[1], v[2])


def _control(v: Array) -> Control:
    return Control(v[0], v[1])
