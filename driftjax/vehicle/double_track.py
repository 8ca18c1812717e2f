"""The plant: a double-track car that simulates the real one."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from driftjax.core import Control, as_float, rk4_step
from driftjax.core.elementary import arctan2, sincos
from driftjax.tyre import MagicFormula, TirTyre
from driftjax.vehicle.actuators import Actuators
from driftjax.vehicle.loads import LOAD_FLOOR, Chassis, smooth_positive
from driftjax.vehicle.wheels import SPEED_FLOOR, Wheels, relaxation_speedup

STEERED = (1.0, 1.0, 0.0, 0.0)


class PlantState(NamedTuple):
    """State of the double-track car; wheels are front left, front right, rear left, rear right."""

    x: Array  # position [m]
    y: Array  # position [m]
    psi: Array  # heading, left positive, not wrapped [rad]
    vx: Array  # forward velocity of the centre of mass [m/s]
    vy: Array  # velocity to the left [m/s]
    r: Array  # yaw rate, left positive [rad/s]
    delta: Array  # road-wheel angle [rad]
    drive: Array  # force of the rear axle that drive and brake ask of it, before the power limit [N]
    pitch: Array  # longitudinal acceleration that the wheel loads follow [m/s^2]
    roll: Array  # lateral acceleration that the wheel loads follow [m/s^2]
    omega: Array  # wheel speeds (4,) [rad/s]
    kappa: Array  # transient longitudinal slips (4,), driving positive [-]
    alpha: Array  # transient lateral slips (4,), positive when the wheel slides to the left [-]


class Motion(NamedTuple):
    """Ideal measurements."""

    V: Array  # speed of the centre of mass [m/s]
    beta: Array  # sideslip, atan2(v_y, v_x), left positive [rad]
    r: Array  # yaw rate, left positive [rad/s]
    x: Array  # position [m]
    y: Array  # position [m]
    psi: Array  # heading, not wrapped [rad]
    ax: Array  # forward specific force at the centre of mass [m/s^2]
    ay: Array  # specific force to the left [m/s^2]
    delta: Array  # road-wheel angle reached [rad]
    Fxr: Array  # axle torque over wheel radius reached, within the power limit [N]
    omega: Array  # wheel speeds (4,) [rad/s]


class Forces(NamedTuple):
    """Forces on the wheels and on the body."""

    Fx: Array  # tyre forces along the wheels (4,) [N]
    Fy: Array  # tyre forces to the left of the wheels (4,) [N]
    Fz: Array  # vertical loads (4,) [N]
    ax: Array  # forward specific force [m/s^2]
    ay: Array  # specific force to the left [m/s^2]
    yaw: Array  # yaw moment [N m]
    drive: Array  # drive force within the power limit [N]
    kappa_rate: Array  # rates of the transient slips (4,) [1/s]
    alpha_rate: Array  # rates of the transient slips (4,) [1/s]


class DoubleTrack(eqx.Module):
    """Rear-driven car on four wheels: spin, combined and transient slip, load transfer, differential, actuators.

    Every parameter is a numeric leaf, so all plants share one program; a leading axis on each leaf is a batch.
    """

    chassis: Chassis
    tyre: MagicFormula | TirTyre
    wheels: Wheels
    actuators: Actuators

    def rolling(
        self, V: ArrayLike, x: ArrayLike = 0.0, y: ArrayLike = 0.0, psi: ArrayLike = 0.0, beta: ArrayLike = 0.0,
        r: ArrayLike = 0.0,
    ) -> PlantState:  # fmt: skip
        """Return the free-rolling state at speed `V` [m/s], by default straight ahead."""
        V, x, y, psi, beta, r = map(as_float, (V, x, y, psi, beta, r))
        zero, none = jnp.zeros_like(V), jnp.zeros(4, V.dtype)
        sin, cos = sincos(beta)
        omega = V * cos / self.wheels.radius * jnp.ones(4, V.dtype)
        return PlantState(x, y, psi, V * cos, V * sin, r + zero, zero, zero, zero, zero, omega, none, none)

    def forces(self, state: PlantState) -> Forces:
        """Return the forces in `state`: slip and load at every wheel, tyre forces, their sum on the body with drag."""
        chassis, wheels = self.chassis, self.wheels
        px, py = chassis.positions()
        steer = state.delta * jnp.array(STEERED, state.delta.dtype)
        sin, cos = sincos(steer)
        hub_x, hub_y = state.vx - state.r * py, state.vy + state.r * px
        v, w = cos * hub_x + sin * hub_y, cos * hub_y - sin * hub_x
        kappa, alpha = state.kappa, state.alpha
        saturation = self.tyre.saturation(kappa, alpha)
        kappa_rate, alpha_rate = wheels.slip_rates(v, w, state.omega, kappa, alpha, saturation)

        Fz0 = chassis.static_loads()
        per_ax, per_ay = chassis.transfer()
        Fz = smooth_positive(Fz0 + per_ax * state.pitch + per_ay * state.roll, LOAD_FLOOR * Fz0)
        damping = wheels.carcass_time / relaxation_speedup(saturation)
        Fx, Fy = self.tyre.forces(kappa + damping * kappa_rate, alpha + damping * alpha_rate, Fz, Fz0)

        body_x, body_y = cos * Fx - sin * Fy, sin * Fx + cos * Fy
        drag = chassis.drag * jnp.sqrt(state.vx**2 + state.vy**2 + SPEED_FLOOR**2)
        drive = self.actuators.limit_power(state.drive, wheels.radius * (state.omega[2] + state.omega[3]) / 2)
        return Forces(
            Fx=Fx,
            Fy=Fy,
            Fz=Fz,
            ax=(body_x.sum() - drag * state.vx) / chassis.m,
            ay=(body_y.sum() - drag * state.vy) / chassis.m,
            yaw=(px * body_y - py * body_x).sum(),
            drive=drive,
            kappa_rate=kappa_rate,
            alpha_rate=alpha_rate,
        )

    def rates(self, state: PlantState, command: Control) -> PlantState:
        """Return the time derivative of `state` under `command`."""
        force, chassis = self.forces(state), self.chassis
        delta_rate, drive_rate = self.actuators.rates(state.delta, state.drive, command)
        sin, cos = sincos(state.psi)
        return PlantState(
            x=cos * state.vx - sin * state.vy,
            y=sin * state.vx + cos * state.vy,
            psi=state.r,
            vx=force.ax + state.r * state.vy,
            vy=force.ay - state.r * state.vx,
            r=force.yaw / chassis.Iz,
            delta=delta_rate,
            drive=drive_rate,
            pitch=(force.ax - state.pitch) / chassis.pitch_lag,
            roll=(force.ay - state.roll) / chassis.roll_lag,
            omega=self.wheels.spin_rates(state.omega, force.drive, force.Fx, force.Fz),
            kappa=force.kappa_rate,
            alpha=force.alpha_rate,
        )

    def advance(self, state: PlantState, command: Control, dt: ArrayLike, num_substeps: int) -> PlantState:
        """Return the state after `dt` [s] of constant `command`, by `num_substeps` Runge-Kutta steps of order 4."""
        flat, unravel = ravel_pytree(state)
        rates = lambda z: ravel_pytree(self.rates(unravel(z), command))[0]
        step = jnp.asarray(dt, flat.dtype) / num_substeps
        last, _ = jax.lax.scan(lambda z, _: (rk4_step(rates, z, step), None), flat, length=num_substeps)
        return unravel(last)

    def motion(self, state: PlantState, command: Control) -> Motion:
        """Return the ideal measurements in `state`; `command` acts only through the state."""
        del command
        force = self.forces(state)
        V = jnp.sqrt(state.vx**2 + state.vy**2 + 1e-12)
        beta = arctan2(state.vy, jnp.where(V < 2e-6, 1e-6, state.vx))  # atan2(0, 0) has no gradient
        return Motion(V, beta, state.r, state.x, state.y, state.psi, force.ax, force.ay, state.delta, force.drive,
                      state.omega)  # fmt: skip

    def sensor_reading(self, state: PlantState, motion: Motion) -> Motion:
        """Return `motion` as the car's sensors read it, noise aside: unchanged."""
        del state
        return motion
