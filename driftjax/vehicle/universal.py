"""The nominal car with any set of effects; at theta = 0 it is exactly the nominal car."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.core.elementary import cos
from driftjax.vehicle.effect.base import Effect, Station
from driftjax.vehicle.effect.flow import (
    Aux,
    CarParameters,
    Flow,
    Place,
    add_accelerations,
    axle_forces,
    initial_flow,
    rates,
)
from driftjax.vehicle.parameters import VehicleConfig
from driftjax.vehicle.single_track import G, SingleTrack

ITERATIONS = 4  # of the drive force, which moves the lateral forces that it is computed beside
LEAST_SLOPE = 0.2  # fall of the missing acceleration with the drive force, times the mass; 1 straight ahead


class Universal(eqx.Module):
    """The nominal car with effects; `theta` is in typical sizes, so it does not depend on units."""

    base: CarParameters
    effects: tuple[Effect, ...] = eqx.field(static=True)
    scale: Float[Array, " K"]  # typical size of each parameter, SI
    theta: Float[Array, " K"]
    substeps: int = eqx.field(static=True)  # in which a step of the log is integrated
    by_acceleration: bool = eqx.field(static=True)  # see `approximate_drive_force`
    car: CarParameters  # `base` after the effects of station `car`; follows from the others, set by `with_parameters`

    def __init__(
        self,
        base: CarParameters,
        effects: tuple[Effect, ...],
        scale: Float[Array, " K"],
        theta: Float[Array, " K"],
        substeps: int = 1,
        by_acceleration: bool = False,
    ):
        self.base, self.effects, self.scale, self.theta, self.substeps = base, effects, scale, theta, substeps
        self.by_acceleration = by_acceleration
        self.car = self._through("car", base)

    def values(self, station: Station | None = None) -> dict[str, tuple[Array, ...]]:
        """Return the parameters of each effect, or of those of one station, SI."""
        values, at = {}, 0
        # the derivative of a split is one concatenation, that of an index an array of zeros for each parameter
        each = jax.lax.split(self.theta * self.scale, (1,) * len(self.theta))
        physical = [one.reshape(one.shape[1:]) for one in each]  # a batch of cars has it on the last axis
        for effect in self.effects:
            if station in (None, effect.station):
                values[effect.name] = tuple(physical[at : at + len(effect.parameters)])
            at += len(effect.parameters)
        return values

    def with_parameters(self, theta: Float[Array, " K"]) -> "Universal":
        """Return the same car with other parameters, in typical sizes."""
        return Universal(self.base, self.effects, self.scale, theta, self.substeps, self.by_acceleration)

    def _through(self, station: Station, record, *context):
        """Apply all effects of a station; a barrier keeps XLA from recomputing them in every derivative it fuses."""
        values = self.values(station)
        for effect in self.effects:
            if effect.station == station:
                record = effect.apply(record, *context, values[effect.name])
        return jax.lax.optimization_barrier(record) if values else record

    def flow(self, x: State, u: Control, place: Place, aux: Aux, near: Array | None = None) -> Flow:
        """Return all intermediate quantities, from slip to forces.

        For a car `by_acceleration` they are linearised about the drive force `near` [N], and taken at one Newton step
        from there: that is exact to second order, and its derivative is that of the implicit function.
        """
        if not self.by_acceleration:
            return self._flow(x, u, place, aux)
        near = jax.lax.stop_gradient(self.approximate_drive_force(x, u, place, aux) if near is None else near)

        def at(F: Array) -> tuple[Flow, Array]:
            flow = self._flow(x, u._replace(Fxr=F), place, aux)
            return flow, self._missing_rate(u, flow)

        (flow, missing), (by_force, slope) = jax.jvp(at, (near,), (jnp.ones_like(near),))
        by_force, slope = jax.lax.stop_gradient((by_force, slope))
        step = missing / jnp.minimum(slope, -LEAST_SLOPE / jax.lax.stop_gradient(self.car.m))
        step = near - self._limited(near - step)
        return jax.tree.map(lambda value, by: value - step * by, flow, by_force)

    def approximate_drive_force(self, x: State, u: Control, place: Place, aux: Aux) -> Array:
        """Approximate the drive force [N] with which the speed changes at the rate u.Fxr / (mass of the nominal car).

        Inverse dynamics for logs without a drive force (`by_acceleration`): that of the car with its effects, not of
        the nominal one, so that no effect is blamed for the error of an estimate. It is at most friction times weight.
        It is not differentiated: `flow` takes the last step, Newton's, and its derivative. For a car whose force is
        known it is that force.
        """
        if not self.by_acceleration:
            return u.Fxr
        model, x, u, place, aux = jax.lax.stop_gradient((self, x, u, place, aux))
        missing = lambda F: model._missing_rate(u, model._flow(x, u._replace(Fxr=F), place, aux))
        approach = lambda _, F: model._limited(F + model.car.m * cos(x.beta) * missing(F))
        return jax.lax.fori_loop(0, ITERATIONS, approach, u.Fxr)

    def _limited(self, F: Array) -> Array:
        """Return the drive force `F` [N], at most friction times weight."""
        most = self.base.mur * self.base.m * G
        return jnp.clip(F, -most, most)

    def _missing_rate(self, u: Control, flow: Flow) -> Array:
        """Return by how much the demanded rate of the speed exceeds that of `flow` [m/s^2]."""
        return u.Fxr / self.base.m - rates(flow).V

    def _flow(self, x: State, u: Control, place: Place, aux: Aux) -> Flow:
        flow = self._through("slip", initial_flow(self.car, x, u, place, aux))
        if any(effect.reads_acceleration for effect in self.effects):
            flow = add_accelerations(flow)
        flow = self._through("load", flow)
        flow = axle_forces(self._through("friction", flow))
        return self._through("force", flow)

    def rates(self, x: State, u: Control, place: Place, aux: Aux) -> State:
        """Return the time derivative of the state; `u` is the output of the actuators."""
        return rates(self.flow(x, u, place, aux))

    def start(self, dt: float) -> tuple:
        """Return the memory of the actuators at rest, for steps of `dt` [s]."""
        return tuple(effect.start(dt) for effect in self.effects if effect.station == "command")

    def apply_actuators(self, memory: tuple, u: Control, V: Array, dt: float | Array) -> tuple[tuple, Control]:
        """Return memory and actuator output for a constant command `u` over one step `dt` [s] at mean speed `V`."""
        values, new, accelerated = self.values("command"), [], u.Fxr
        commands = [effect for effect in self.effects if effect.station == "command"]
        for effect, held in zip(commands, memory, strict=True):
            after, u = effect.apply(held, u, V, dt, values[effect.name])
            new.append(after)
        return tuple(new), u._replace(Fxr=accelerated) if self.by_acceleration else u

    @property
    def _delays(self) -> np.ndarray:
        """Return the indices of the parameters that are delays of V, beta and r; empty if no effect has any."""
        return np.flatnonzero([effect.sensor_delay for effect in self.effects for _ in effect.parameters])

    def split_delays(self, dt: float | Array) -> tuple[Float[Array, "3"], "Universal"]:
        """Return the sensor delays of V, beta, r in whole steps `dt` [s], and the car with the remaining delays."""
        at = self._delays
        if not len(at):
            return jnp.zeros(3), self
        whole = jnp.floor(self.theta[at] * self.scale[at] / dt)
        return whole, self.with_parameters(self.theta.at[at].add(-whole * dt / self.scale[at]))

    def without_delays(self) -> "Universal":
        """Return the car with sensors that are not late."""
        return self.with_parameters(self.theta.at[self._delays].set(0.0)) if len(self._delays) else self

    def sensor_delays(self) -> Float[Array, "3"]:
        """Return the sensor delays of V, beta and r [s]."""
        at = self._delays
        return self.theta[at] * self.scale[at] if len(at) else jnp.zeros(3)

    def sense(self, x: State, dx: State) -> State:
        """Return the measured state without noise; `dx` is the mean rate over the delay."""
        return self._through("sensor", x, dx)


def base_car(nominal: SingleTrack) -> CarParameters:
    """Return the nominal car as `CarParameters`."""
    tyre, zero = nominal.tyre, jnp.zeros_like(nominal.m)
    return CarParameters(
        nominal.m, nominal.Iz, nominal.a, nominal.b, tyre.mu, tyre.mu, tyre.B, tyre.B, tyre.C, tyre.C,
        nominal.combined_slip**2, zero, zero,
    )  # fmt: skip


def universal_car(
    vehicle: VehicleConfig, effects: tuple[Effect, ...], substeps: int = 1, by_acceleration: bool = False
) -> Universal:
    """Return the car with these effects, all neutral."""
    scale = [parameter.scale(vehicle) for effect in effects for parameter in effect.parameters]
    theta = jnp.zeros(len(scale))
    return Universal(base_car(vehicle.build()), effects, jnp.asarray(scale), theta, substeps, by_acceleration)
