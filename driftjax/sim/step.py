"""One step of the universal car from inside: what acts, what tyres and body are behind, and the rates they make."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State, lag_step
from driftjax.core.integrate import axpy, lag_slope
from driftjax.vehicle.effect.flow import Aux, Place, rates
from driftjax.vehicle.universal import Universal

SLOWEST = 0.1  # speed below which the relaxation of the slip angles gets no slower [m/s]


class Acts(NamedTuple):
    """What acts over one step: the straight line nearest to what the actuators do."""

    mean: Control
    tilt: Control  # half the rise over the step

    def at(self, share: Array | float) -> Control:
        """What acts at a `share` of the step."""
        return axpy(2 * share - 1, self.tilt, self.mean)


class Felt(NamedTuple):
    """What follows the state with a lag, carried from step to step."""

    slip: Float[Array, "2"]  # slip angles of front and rear as the tyres feel them [rad]
    ay: Array  # lateral acceleration that roll has reached [m/s^2]


class Begun(NamedTuple):
    """A step at its begin, with what has to be known there of what lags during it."""

    x: State
    felt: Felt
    acts: Acts
    slip_rate: Float[Array, "2"]  # of the geometric slip angles
    ay: Array  # lateral acceleration


def held(u: Control) -> Acts:
    """`u` over the whole step."""
    return Acts(u, Control(jnp.zeros_like(u.delta), jnp.zeros_like(u.Fxr)))


def acts_of(u: Float[Array, "4"]) -> Acts:
    """Mean steering [rad] and drive [N], and their tilts."""
    return Acts(Control(u[0], u[1]), Control(u[2], u[3]))


def middles(num: int) -> np.ndarray:
    """Middles of `num` equal parts of a step, from -1 at its begin to 1 at its end."""
    return (2 * np.arange(num) + 1) / num - 1


def part(u: Float[Array, "4 *k"], middle: Array, num: int) -> Float[Array, "4 *k"]:
    """The line of `acts_of` over one of `num` equal parts of its step, about `middle`; or derivatives of such lines."""
    return jnp.concatenate([u[:2] + middle * u[2:], u[2:] / num])


def motion(model: Universal, x: State, u: Control, place: Place, aux: Aux) -> tuple[State, Array]:
    """Rates of the state, and the lateral acceleration."""
    # without the barrier XLA works out each stage of a Runge-Kutta step anew for every entry of the next
    x, aux = jax.lax.optimization_barrier((x, aux))
    flow = model.flow(x, u, place, aux)
    return jax.lax.optimization_barrier((rates(flow), flow.ay))


def slip_of(model: Universal, x: State, u: Control) -> Float[Array, "2"]:
    """Geometric slip angles of front and rear [rad]."""
    return jnp.stack(model.car.nominal.slip_angles(x, u))


def time_of(model: Universal, x: State) -> Array:
    """Time of the relaxation at this speed [s]."""
    return model.car.relaxation / jnp.maximum(x.V, SLOWEST)


def fades(time: Array, share: Array | float, dt: Array) -> Array:
    """What is left at a `share` of a step of something that fades with this `time` constant.

    It stands as the straight line of its mean and first moment, so that nothing is left of it without a lag.
    """
    return lag_step(jnp.ones(()), jnp.zeros(()), time, dt)[0] + (2 * share - 1) * lag_slope(time, dt)


class Bend(NamedTuple):
    """A parabola through the slip at the begin of a step, its rate there and the slip at one later time."""

    start: Float[Array, "2"]  # what tyres are behind at its begin, less what they would be for good on the parabola
    behind: Float[Array, "2"]  # what they would be for good at the later time


def bend(model: Universal, begun: Begun, slip: Array, time: Array, after: Array) -> Bend:
    """The parabola to the `slip` that is reached a time `after` the begin, for tyres of this `time` constant."""
    start = slip_of(model, begun.x, begun.acts.at(0.0))
    half = (slip - start - begun.slip_rate * after) / after**2
    first, last = begun.slip_rate, begun.slip_rate + 2 * half * after
    return Bend(begun.felt.slip - start + time * first - 2 * time**2 * half, 2 * time**2 * half - time * last)


def plus(dx: State, push: State | None) -> State:
    """The rates `dx` with those of a `push`, if there is any."""
    return dx if push is None else axpy(1.0, push, dx)


def slip_rate(model: Universal, x: State, dx: State, u: Control, du: Control) -> Float[Array, "2"]:
    """Rates of the geometric slip angles [rad/s] where state and actuators change at the rates `dx` and `du`."""
    return jax.jvp(lambda y, u: slip_of(model, y, u), (x, u), (dx, du))[1]


def settled(model: Universal, x: State, u: Control, place: Place) -> Felt:
    """What is felt where the state has been moving as it does now for longer than the lags."""
    dx, ay = motion(model, x, u, place, Aux(jnp.zeros(2), jnp.zeros(())))
    moving = slip_rate(model, x, dx, u, Control(*jnp.zeros(2)))
    return Felt(slip_of(model, x, u) - time_of(model, x) * moving, ay)


def begin_step(
    model: Universal, x: State, felt: Felt, acts: Acts, place: Place, dt: Array, push: State | None = None
) -> Begun:
    """What has to be known at the begin of a step; `push` is added to the rates."""
    u, rise = acts.at(0.0), Control(*(2 * tilt / dt for tilt in acts.tilt))
    behind = (felt.slip - slip_of(model, x, u)) * fades(time_of(model, x), 0.0, dt)
    dx, ay = motion(model, x, u, place, Aux(behind, jnp.zeros(())))
    return Begun(x, felt, acts, slip_rate(model, x, plus(dx, push), u, rise), ay)


def lagging(model: Universal, begun: Begun, y: State, share: Array, dt: Array) -> Aux:
    """What lags in the state `y` at a `share` of a step."""
    time, there = time_of(model, begun.x), share > 0
    start = slip_of(model, begun.x, begun.acts.at(0.0))
    slip = jnp.where(there, slip_of(model, y, begun.acts.at(share)), start + begun.slip_rate * dt)
    at = bend(model, begun, slip, time, jnp.where(there, share, 1.0) * dt)
    ay = lag_step(begun.felt.ay, begun.ay, model.car.roll_lag, dt)[0]
    return Aux(at.start * fades(time, share, dt) + at.behind, ay - begun.ay)


def felt_after(model: Universal, begun: Begun, x: State, dt: Array) -> Felt:
    """What is felt at the end `x` of a step."""
    time, slip = time_of(model, begun.x), slip_of(model, x, begun.acts.at(1.0))
    at = bend(model, begun, slip, time, dt)
    _, end = lag_step(at.start, jnp.zeros(2), time, dt)
    return Felt(slip + end + at.behind, lag_step(begun.felt.ay, begun.ay, model.car.roll_lag, dt)[1])


def rate_during(
    model: Universal, begun: Begun, place: Place, dt: Array, push: State | None
) -> Callable[[tuple[State, Array]], tuple[State, Array]]:
    """Rates of the state and of the share of a step gone by; `push` is added to the former."""

    def rate(now: tuple[State, Array]) -> tuple[State, Array]:
        y, share = now
        dx = motion(model, y, begun.acts.at(share), place, lagging(model, begun, y, share, dt))[0]
        return plus(dx, push), 1 / dt

    return rate
