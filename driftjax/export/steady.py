"""Steady cornering and grip limits of a car: tables for planners and steering controllers."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.export.target import car_with
from driftjax.parallel import call
from driftjax.vehicle import AnyCar, VehicleConfig, build_car
from driftjax.vehicle.effect import Place, effects_by_name
from driftjax.vehicle.effect.flow import Aux
from driftjax.vehicle.single_track import G
from driftjax.vehicle.universal import Universal

NEWTON = 4  # iterations at each steering angle
STILL = 1e-6  # largest acceleration left in a steady state [g]
SLIPS = 120  # slip angles at which an axle's largest force is sought
STEEPEST = 3.0  # up to this multiple of the slip angle at the nominal tyre's peak
BODY = ("car", "slip", "load", "friction", "force")  # stations of effects on the body; commands are as they are
FORCES = 400  # brake forces at which the first axle's limit is sought


def cornering(vehicle: VehicleConfig, delta: np.ndarray, V: np.ndarray) -> Float[np.ndarray, "D S"]:
    """Return the lateral acceleration [m/s^2] of steady cornering at steering `delta` (D,) [rad] and speed `V` (S,).

    `delta` grows in small steps from about 0. Speed is constant, without drive. NaN from where the car finds no stable
    steady state. The car has all its effects that act in steady state.
    """
    r, stable = call(_follow, build_car(vehicle), jnp.asarray(delta), jnp.asarray(V))
    kept = np.logical_and.accumulate(np.asarray(stable), axis=0)
    return np.where(kept, np.asarray(r) * V, np.nan)


def _follow(car: AnyCar, delta: Array, V: Array) -> tuple[Array, Array]:
    """Return yaw rate and stability (D, S) of the steady states, by Newton's method from each angle to the next."""

    def rates(x: Array, delta: Array, V: Array) -> Array:
        dx = car(State(V, x[0], x[1]), Control(delta, jnp.zeros_like(V)))
        return jnp.stack([dx.beta * V, dx.r * (car.a + car.b)])  # accelerations

    def on(x: Array, delta: Array) -> tuple[Array, tuple[Array, Array]]:
        def newton(x: Array, _: None) -> tuple[Array, None]:
            J = jax.vmap(jax.jacfwd(rates), (0, None, 0))(x, delta, V)
            det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
            f = jax.vmap(rates, (0, None, 0))(x, delta, V)
            left = jnp.stack([J[:, 1, 1] * f[:, 0] - J[:, 0, 1] * f[:, 1], J[:, 0, 0] * f[:, 1] - J[:, 1, 0] * f[:, 0]])
            return x - (left / det).T, None

        x = jax.lax.scan(newton, x, length=NEWTON)[0]
        f = jax.vmap(rates, (0, None, 0))(x, delta, V)
        J = jax.vmap(jax.jacfwd(rates), (0, None, 0))(x, delta, V)
        real = jnp.stack([J[:, 0] / V[:, None], J[:, 1] / (car.a + car.b)], axis=1)
        det = real[:, 0, 0] * real[:, 1, 1] - real[:, 0, 1] * real[:, 1, 0]
        stable = (jnp.abs(f).max(axis=1) < STILL * G) & (real[:, 0, 0] + real[:, 1, 1] < 0) & (det > 0)
        return x, (x[:, 1], stable)

    return jax.lax.scan(on, jnp.zeros((len(V), 2)), delta)[1]


def truncate_at_peak(table: np.ndarray) -> np.ndarray:
    """Truncate a table (D, S) at its first maximum along the steering, NaN beyond, so that it can be inverted."""
    table = table.copy()
    for column in table.T:
        falls = np.flatnonzero(~(np.diff(column) > 0))
        if len(falls):
            column[falls[0] + 1 :] = np.nan
    return table


def grip_limits(vehicle: VehicleConfig, V: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the largest braking, driving and lateral acceleration (S,) that the tyres allow at `V` (S,) [m/s^2].

    Braking ends where the first axle reaches its friction, with the split of the brake force; driving likewise.
    Cornering ends where the first axle reaches its largest side force, in balance about the yaw axis.
    """
    named = effects_by_name(tuple({one.effect for one in vehicle.effects} - {"traction_limit"}))  # that hides a limit
    steady = [one for one in named if one.station in BODY and not (one.kinematic or one.needs or one.transient)]
    car = car_with(vehicle, tuple(one.name for one in steady))
    peak = float(vehicle.build().tyre.alpha_peak)
    slips = jnp.asarray(np.linspace(0.0, STEEPEST * peak, SLIPS))
    force = jnp.asarray(np.linspace(0.0, 2.0 * vehicle.m * G, FORCES))
    brake, drive, side = call(_limits, car, jnp.asarray(V), slips, force)
    return np.asarray(brake), np.asarray(drive), np.asarray(side)


def _limits(model: Universal, V: Array, slips: Array, force: Array) -> tuple[Array, Array, Array]:
    body, zero = model.car, jnp.zeros(())
    flow_of = lambda x, u: model.flow(x, u, Place(zero, zero, zero, zero), Aux(jnp.zeros(2), zero))

    def pull(sign: float, V: Array) -> Array:
        """Return the largest acceleration before an axle slides, driving (1) or braking (-1)."""
        flow = jax.vmap(lambda F: flow_of(State(V, zero, zero), Control(zero, sign * F)))(force)
        held = (jnp.abs(flow.Fxf) <= flow.muf * flow.Fzf) & (jnp.abs(flow.Fxr) <= flow.mur * flow.Fzr)
        last = jnp.where(held.all(), len(force), jnp.argmin(held)) - 1
        return force[jnp.maximum(last, 0)] / body.m

    def side(V: Array) -> Array:
        """Return the largest lateral acceleration to the left: both axles slip by as much to the right."""

        def at(alpha: Array) -> tuple[Array, Array]:
            flow = flow_of(State(V, -alpha, zero), Control(zero, zero))
            return flow.Fyf, flow.Fyr

        front, rear = jax.vmap(at)(slips)
        return jnp.minimum(front.max() / body.b, rear.max() / body.a) * body.wheelbase / body.m

    return jax.vmap(lambda V: pull(-1.0, V))(V), jax.vmap(lambda V: pull(1.0, V))(V), jax.vmap(side)(V)
