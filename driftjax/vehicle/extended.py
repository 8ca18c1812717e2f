"""The car for planning, control and learning: the nominal car with the effects identified by a diagnosis."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import BadInput, Control, State
from driftjax.environment import require_float64
from driftjax.tyre import SimplifiedPacejka
from driftjax.vehicle.effect import EFFECTS, effects_by_name
from driftjax.vehicle.effect.base import Effect, Parameter
from driftjax.vehicle.effect.flow import Aux, Flow, Place, rates
from driftjax.vehicle.parameters import VehicleConfig
from driftjax.vehicle.single_track import SingleTrack
from driftjax.vehicle.universal import Universal, base_car

LAGS = ("steer_lag", "drive_lag")  # effects that are states of the MPC, with the time constant as only parameter
STEP = 1.0  # time step given to command effects without memory, which do not look at it [s]


class Extended(eqx.Module):
    """The nominal car with named effects in steady state, used like a `SingleTrack`; calling it returns the rates.

    It is the `Universal` car with these effects only, with settled tyres and body and no dependence on place. Command
    effects are included: `u` is the command after its lags.
    """

    nominal: SingleTrack
    names: tuple[str, ...] = eqx.field(static=True)  # of the effects; names, so that a compiled program can be kept
    scale: Float[Array, " K"]  # typical size of each parameter, SI
    theta: Float[Array, " K"]  # parameters in typical sizes, in the catalogue's order

    @property
    def m(self) -> Array:
        """Return the mass of the nominal car [kg], as the unit of forces."""
        return self.nominal.m

    @property
    def Iz(self) -> Array:
        """Return the yaw inertia of the nominal car [kg m^2], as the unit of moments."""
        return self.nominal.Iz

    @property
    def a(self) -> Array:
        """Return the nominal centre of mass to front axle [m], as the unit of lengths."""
        return self.nominal.a

    @property
    def b(self) -> Array:
        """Return the nominal centre of mass to rear axle [m]."""
        return self.nominal.b

    @property
    def tyre(self) -> SimplifiedPacejka:
        """Return the tyre of the nominal car, as the unit of friction."""
        return self.nominal.tyre

    @property
    def universal(self) -> Universal:
        """Return the universal car with the same effects."""
        return Universal(base_car(self.nominal), effects_by_name(self.names), self.scale, self.theta)

    def with_parameters(self, theta: Float[Array, " K"]) -> "Extended":
        """Return this car with other parameters."""
        return Extended(self.nominal, self.names, self.scale, theta)

    def columns(self, effects: tuple[str, ...]) -> np.ndarray:
        """Return the indices in `theta` of the parameters of these effects; of those that the car has."""
        return np.flatnonzero([effect.name in effects for effect, _ in _parameters(self.names)])

    @property
    def parameter_names(self) -> list[str]:
        """Return the names `effect.parameter` of `theta`."""
        return [f"{effect.name}.{p.name}" for effect, p in _parameters(self.names)]

    @property
    def limits(self) -> Float[Array, "2 K"]:
        """Return the smallest and largest `theta`."""
        return jnp.array([(p.lower, p.upper) for _, p in _parameters(self.names)]).T

    def scaled(self, share: Array) -> "Extended":
        """Return the nominal car at 0, this car at 1, and linear parameters between."""
        return self.with_parameters(share * self.theta)

    def flow(self, x: State, u: Control) -> Flow:
        """Return all intermediate quantities, from slip to forces."""
        model, zero = self.universal, jnp.zeros_like(x.V)
        _, acting = model.apply_actuators(model.start(STEP), u, x.V, STEP)
        return model.flow(x, acting, Place(zero, zero, zero, zero), Aux(jnp.stack([zero, zero]), zero))

    def __call__(self, x: State, u: Control) -> State:
        """Return the time derivative of `x`."""
        return rates(self.flow(x, u))

    def slip_angles(self, x: State, u: Control) -> tuple[Array, Array]:
        """Return the front and rear slip angle [rad]."""
        flow = self.flow(x, u)
        return flow.alpha_f, flow.alpha_r

    @property
    def peaks(self) -> tuple[Array, Array]:
        """Return the slip angle at which the front and the rear tyre reach their largest force [rad]."""
        car = self.universal.car
        return car.tyre_f.alpha_peak, car.tyre_r.alpha_peak


AnyCar = SingleTrack | Extended


def beyond_peak(car: AnyCar, x: State, u: Control) -> Array:
    """Return the front slip angle beyond the peak of the tyre force [rad], 0 below it."""
    alpha_f, _ = car.slip_angles(x, u)
    return jnp.maximum(jnp.abs(alpha_f) - car.peaks[0], 0.0)


def build_car(vehicle: VehicleConfig, free: tuple[str, ...] = ()) -> AnyCar:
    """Build the car that `vehicle` describes: the nominal one with its named effects that act in steady state.

    The effects `free` are added where not named, at their neutral value.

    `car(x, u)` returns the rates of a `State` x under a `Control` u, SI per second, differentiable by both and by the
    car's own parameters. Effects of sensors, delays and the road are left out (see `unmodelled_effects`).
    """
    require_float64()
    values = {(one.effect, one.parameter): one.value for one in vehicle.effects}
    wanted = _named(vehicle) | set(free)
    names = tuple(name for name in EFFECTS if name in wanted and not exclusion_reason(EFFECTS[name]))
    if not names:
        return vehicle.build()
    each = _parameters(names)
    scale = jnp.asarray([p.scale(vehicle) for _, p in each])
    theta = jnp.asarray([values.get((effect.name, p.name), 0.0) for effect, p in each]) / scale
    return Extended(vehicle.build(), names, scale, theta)


def actuator_lags(vehicle: VehicleConfig) -> Float[Array, "2"]:
    """Return the identified time constants of steering and drive [s], 0 if none was named."""
    values = {one.effect: one.value for one in vehicle.effects}
    return jnp.asarray([values.get(name, 0.0) for name in LAGS])


def exclusion_reason(effect: Effect) -> str:
    """Return why `effect` is not part of the car in steady state; empty if it is."""
    if effect.station == "sensor":
        return "it belongs to the sensors"
    if effect.kinematic or effect.needs:
        return "it belongs to the road or the weather of the measurement"
    if effect.name in LAGS:
        return "plans and steady states know no lags; the MPC of `driftjax learn` starts from it"
    remembers = effect.station == "command" and bool(jax.tree.leaves(effect.start(STEP)))
    if remembers or effect.transient:
        return "it acts by what went before, which no function of the present state can say"
    return ""


def require_steady(names: tuple[str, ...]) -> None:
    """Raise `BadInput` where one of the effects is unknown or not part of the car in steady state."""
    for name in names:
        if name not in EFFECTS or exclusion_reason(EFFECTS[name]):
            known = ", ".join(one for one, effect in EFFECTS.items() if not exclusion_reason(effect))
            raise BadInput(f"key 'effects' names '{name}'; choose among {known}.")


def unmodelled_effects(vehicle: VehicleConfig) -> list[str]:
    """Return one sentence per named effect that planner, equilibria and MPC do not model."""
    named = [effect for effect in EFFECTS.values() if effect.name in _named(vehicle)]
    return [
        f"{effect.name} is not in the car: {exclusion_reason(effect)}." for effect in named if exclusion_reason(effect)
    ]


def _parameters(names: tuple[str, ...]) -> list[tuple[Effect, Parameter]]:
    return [(effect, p) for effect in effects_by_name(names) for p in effect.parameters]


def _named(vehicle: VehicleConfig) -> set[str]:
    return {one.effect for one in vehicle.effects}
