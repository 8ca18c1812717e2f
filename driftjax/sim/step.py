"""One step of the universal car: inputs over the step, lagged slip and roll, and the resulting rates."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State, lag_step
from driftjax.core.integrate import RK4, Tableau, axpy, lag_slope
from driftjax.vehicle.effect.flow import Aux, Place, rates
from driftjax.vehicle.universal import Universal

MIN_SPEED = 0.1  # speed below which the relaxation time of the slip angles is constant [m/s]


class FirstOrderHold(NamedTuple):
    """Inputs over one step: the least-squares line through the actuator response."""

    mean: Control
    slope: Control  # half the change over the step

    def at(self, share: Array | float) -> Control:
        """Return the input at a fraction `share` of the step."""
        return axpy(2 * share - 1, self.slope, self.mean)


class LaggedState(NamedTuple):
    """Quantities that follow the state with a lag, carried from step to step."""

    slip: Float[Array, "2"]  # relaxed slip angles of front and rear [rad]
    ay: Array  # lateral acceleration followed by the roll [m/s^2]


class StepStart(NamedTuple):
    """State at the start of a step, with what the lags during the step depend on."""

    x: State
    lagged: LaggedState
    hold: FirstOrderHold
    slip_rate: Float[Array, "2"]  # of the geometric slip angles
    ay: Array  # lateral acceleration


def constant_hold(u: Control) -> FirstOrderHold:
    """Hold `u` constant over the whole step."""
    return FirstOrderHold(u, Control(jnp.zeros_like(u.delta), jnp.zeros_like(u.Fxr)))


def hold_of(u: Float[Array, "4"]) -> FirstOrderHold:
    """Build a hold from mean steering [rad] and drive [N], and their slopes."""
    return FirstOrderHold(Control(u[0], u[1]), Control(u[2], u[3]))


def midpoints(num: int) -> np.ndarray:
    """Return the midpoints of `num` equal parts of a step, scaled to -1 at its start and 1 at its end."""
    return (2 * np.arange(num) + 1) / num - 1


def hold_segment(u: Float[Array, "4 *k"], middle: Array, num: int) -> Float[Array, "4 *k"]:
    """Restrict the line of `hold_of`, or its derivatives, to one of `num` equal parts of its step, about `middle`."""
    return jnp.concatenate([u[:2] + middle * u[2:], u[2:] / num])


def motion(
    model: Universal, x: State, u: Control, place: Place, aux: Aux, near: Array | None = None
) -> tuple[State, Array, Array]:
    """Return the rates of the state, the lateral acceleration and the drive force; for `near` see `Universal.flow`."""
    # without the barrier XLA recomputes each Runge-Kutta stage for every entry of the next
    x, aux = jax.lax.optimization_barrier((x, aux))
    flow = model.flow(x, u, place, aux, near)
    return jax.lax.optimization_barrier((rates(flow), flow.ay, flow.u.Fxr))


def slip_of(model: Universal, x: State, u: Control) -> Float[Array, "2"]:
    """Return the geometric slip angles of front and rear [rad]."""
    return jnp.stack(model.car.nominal.slip_angles(x, u))


def relaxation_time(model: Universal, x: State) -> Array:
    """Return the relaxation time of the tyres at this speed [s]."""
    return model.car.relaxation / jnp.maximum(x.V, MIN_SPEED)


def lag_decay(time: Array, share: Array | float, dt: Array) -> Array:
    """Return the remaining fraction at `share` of a step of a quantity that decays with this `time` constant.

    It is represented by the line with the same mean and first moment, which vanishes without a lag.
    """
    return lag_step(jnp.ones(()), jnp.zeros(()), time, dt)[0] + (2 * share - 1) * lag_slope(time, dt)


class SlipParabola(NamedTuple):
    """Parabola through the slip at the start of a step, its rate there, and the slip at one later time."""

    start: Float[Array, "2"]  # lag at the start, minus the stationary lag on the parabola
    behind: Float[Array, "2"]  # stationary lag at the later time


def slip_parabola(model: Universal, at_start: StepStart, slip: Array, time: Array, after: Array) -> SlipParabola:
    """Fit the parabola to the `slip` reached a time `after` the start, for tyres of this `time` constant."""
    start = slip_of(model, at_start.x, at_start.hold.at(0.0))
    half = (slip - start - at_start.slip_rate * after) / after**2
    first, last = at_start.slip_rate, at_start.slip_rate + 2 * half * after
    return SlipParabola(
        at_start.lagged.slip - start + time * first - 2 * time**2 * half, 2 * time**2 * half - time * last
    )


def slip_rate(model: Universal, x: State, dx: State, u: Control, du: Control) -> Float[Array, "2"]:
    """Return the rates of the geometric slip angles [rad/s] for rates `dx` of the state and `du` of the inputs."""
    return jax.jvp(lambda y, u: slip_of(model, y, u), (x, u), (dx, du))[1]


def steady_lagged_state(model: Universal, x: State, u: Control, place: Place) -> LaggedState:
    """Return the lagged state of a car that has moved as it does now for longer than the lags."""
    dx, ay, _ = motion(model, x, u, place, Aux(jnp.zeros(2), jnp.zeros(())))
    moving = slip_rate(model, x, dx, u, Control(*jnp.zeros(2)))
    return LaggedState(slip_of(model, x, u) - relaxation_time(model, x) * moving, ay)


def first_offsets(model: Universal, at_start: StepStart, dt: Array) -> Aux:
    """Return the lag offsets of slip and roll at the start of a step, before its rates are known."""
    slip = slip_of(model, at_start.x, at_start.hold.at(0.0))
    behind = (at_start.lagged.slip - slip) * lag_decay(relaxation_time(model, at_start.x), 0.0, dt)
    return Aux(behind, jnp.zeros(()))


def lag_offsets(model: Universal, at_start: StepStart, y: State, share: Array, dt: Array) -> Aux:
    """Return the lag offsets of slip and roll in the state `y` at a fraction `share` of a step."""
    time, there = relaxation_time(model, at_start.x), share > 0
    start = slip_of(model, at_start.x, at_start.hold.at(0.0))
    slip = jnp.where(there, slip_of(model, y, at_start.hold.at(share)), start + at_start.slip_rate * dt)
    at = slip_parabola(model, at_start, slip, time, jnp.where(there, share, 1.0) * dt)
    ay = lag_step(at_start.lagged.ay, at_start.ay, model.car.roll_lag, dt)[0]
    return Aux(at.start * lag_decay(time, share, dt) + at.behind, ay - at_start.ay)


def lagged_after(model: Universal, at_start: StepStart, x: State, dt: Array) -> LaggedState:
    """Return the lagged state at the end `x` of a step."""
    time, slip = relaxation_time(model, at_start.x), slip_of(model, x, at_start.hold.at(1.0))
    at = slip_parabola(model, at_start, slip, time, dt)
    _, end = lag_step(at.start, jnp.zeros(2), time, dt)
    return LaggedState(slip + end + at.behind, lag_step(at_start.lagged.ay, at_start.ay, model.car.roll_lag, dt)[1])


def _evaluate(
    model: Universal,
    at_start: StepStart,
    y: Float[Array, "3"],
    share: Array,
    first: Array,
    place: Place,
    dt: Array,
    push: Float[Array, "3"],
    excess: Array,
) -> tuple[Float[Array, "4"], Array]:
    """Return the rates of V, beta and r, `push` added, with the lateral acceleration, at a fraction `share` of a step.

    At the `first` evaluation, at the start of the step, the quantities that the lags depend on are not known yet; they
    follow from its result. `excess` is the drive force less the input of the evaluation before; that of this one is
    returned too.
    """
    x = State(y[0], y[1], y[2])
    offsets = first_offsets(model, at_start, dt), lag_offsets(model, at_start, x, share, dt)
    aux = jax.tree.map(lambda a, b: jnp.where(first, a, b), *offsets)
    u = at_start.hold.at(share)
    dx, ay, force = motion(model, x, u, place, aux, u.Fxr + excess)
    return jnp.concatenate([jnp.stack(dx) + push, ay[None]]), force - u.Fxr


def _first_slip_rate(model: Universal, at_start: StepStart, dx: Float[Array, "3"], dt: Array) -> Float[Array, "2"]:
    """Return the rates of the geometric slip angles at the start of a step, for rates `dx` of the state."""
    rise = Control(*(2 * slope / dt for slope in at_start.hold.slope))
    return slip_rate(model, at_start.x, State(dx[0], dx[1], dx[2]), at_start.hold.at(0.0), rise)


def _evaluations(method: Tableau, dtype: jnp.dtype) -> tuple[Array, Array, Array]:
    """Return for each evaluation of a step whether it is the first, its node, and its weight in the step."""
    into, weights = (jnp.asarray(np.concatenate([[0.0], row]), dtype) for row in method)
    return jnp.arange(len(into)) == 0, into, weights


def lagged_step(
    model: Universal,
    x: State,
    lagged: LaggedState,
    hold: FirstOrderHold,
    place: Place,
    dt: Array,
    push: State | None = None,
    method: Tableau = RK4,
) -> tuple[State, LaggedState, State, State]:
    """Return state and lagged state one step `dt` [s] later, and the rates of the state at its start and end.

    `push` is added to the rates. The evaluations are a loop: a fifth of the program, and so of the time to compile it.
    """
    start = jnp.stack(x)
    nothing = jnp.zeros_like(start)
    added = nothing if push is None else jnp.stack(push)
    if model.by_acceleration:  # the force is that with which the speed changes so
        hold = hold._replace(mean=hold.mean._replace(Fxr=hold.mean.Fxr + model.base.m * added[0]))
        added = added.at[0].set(0.0)
    begun = lambda known: StepStart(x, lagged, hold, known[:2], known[2])
    offsets = first_offsets(model, begun(nothing), dt)
    u = hold.at(0.0)
    above = model.approximate_drive_force(x, u, place, offsets) - u.Fxr

    def on(carry, row):
        k, end, known, above = carry
        first, into, weight = row
        derivative, above = _evaluate(model, begun(known), start + into * dt * k, into, first, place, dt, added, above)
        moving = _first_slip_rate(model, begun(known), derivative[:3], dt)
        k = jnp.where(first, k, derivative[:3])
        known = jnp.where(first, jnp.concatenate([moving, derivative[3:]]), known)
        return (k, end + weight * dt * k, known, above), k

    evaluations = _evaluations(method, start.dtype)
    (_, end, known, _), slopes = jax.lax.scan(on, (nothing, start, nothing, above), evaluations)
    end = State(end[0], end[1], end[2])
    return end, lagged_after(model, begun(known), end, dt), State(*slopes[1]), State(*slopes[-1])
