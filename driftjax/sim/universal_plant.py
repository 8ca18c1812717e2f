"""A plant with effects of the catalogue: the car of `driftjax simulate`, driven round a track."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from driftjax.core import Control, State, as_float
from driftjax.sim.record import specific_force
from driftjax.sim.step import steady_lagged_state
from driftjax.sim.travel import Travel, delay_buffer, sensor_reading, travel
from driftjax.vehicle import DoubleTrack, Motion, SingleTrack, VehicleConfig
from driftjax.vehicle.effect import EFFECTS, Place, effects_by_name
from driftjax.vehicle.universal import Universal, base_car


class UniversalPlant(eqx.Module):
    """The `Universal` car with the interface of a `DoubleTrack`: pose, actuators, tyres and body, sensors.

    A leading axis on each leaf is a batch. It has the given effects and no other limits: commands are assumed to be
    within those of the car.
    """

    nominal: SingleTrack
    names: tuple[str, ...] = eqx.field(static=True)  # of the effects; names, so that compiled programs can be cached
    scale: Float[Array, " K"]  # typical size of each parameter, SI
    theta: Float[Array, " K"]  # parameters in typical sizes, in the catalogue's order
    lap: Array = eqx.field(converter=as_float)  # length of one lap, for the position along it [m]
    step: float = eqx.field(static=True)  # shortest substep that the actuator buffers allow [s]

    @property
    def universal(self) -> Universal:
        """Return the universal car model."""
        return Universal(base_car(self.nominal), effects_by_name(self.names), self.scale, self.theta)

    def rolling(
        self, V: ArrayLike, x: ArrayLike = 0.0, y: ArrayLike = 0.0, psi: ArrayLike = 0.0, beta: ArrayLike = 0.0,
        r: ArrayLike = 0.0,
    ) -> Travel:  # fmt: skip
        """Return the state at speed `V` [m/s] at the start of a lap, actuators at rest; straight unless `beta`, `r`."""
        model, V = self.universal, as_float(V)
        zero = jnp.zeros_like(V)
        state, idle = State(V, zero + beta, zero + r), Control(zero, zero)
        place = Place(zero, as_float(psi), zero, zero)
        lagged = steady_lagged_state(model, state, idle, place)
        position = jnp.stack([as_float(x), as_float(y)])
        still = State(zero, zero, zero)
        past, step = delay_buffer(model, state, self.step), jnp.full_like(V, self.step)
        return Travel(state, lagged, model.start(self.step), place, position, zero, still, idle, past, step)

    def advance(self, state: Travel, command: Control, dt: ArrayLike, num_substeps: int) -> Travel:
        """Return the state after `dt` [s] of constant `command` in `num_substeps` steps, none shorter than `step`."""
        model, h = self.universal, as_float(dt) / num_substeps
        fine = lambda now, _: (travel(model, self.nominal, self.lap, now, command, h), None)
        return jax.lax.scan(fine, state, length=num_substeps)[0]

    def motion(self, state: Travel, command: Control) -> Motion:
        """Return the motion as ideal sensors would measure it; this car has no wheel spin, so wheel speeds are NaN."""
        del command
        x, acting = state.x, state.acting
        (px, py), psi = state.position, state.place.psi
        ax, ay = specific_force(self.universal, x, state.rate, acting, state.place)
        return Motion(x.V, x.beta, x.r, px, py, psi, ax, ay, acting.delta, acting.Fxr, jnp.full(4, jnp.nan))

    def sensor_reading(self, state: Travel, motion: Motion) -> Motion:
        """Return `motion` as the car's sensors read it, noise aside; position and heading are exact."""
        return motion._replace(**sensor_reading(self.universal, state)._asdict())


AnyPlant = DoubleTrack | UniversalPlant


def plant_of(vehicle: VehicleConfig, theta: np.ndarray, lap: float, step: float) -> UniversalPlant:
    """Build a plant from the nominal car of `vehicle` with catalogue effects at `theta` (in typical sizes).

    Effects at 0 are omitted, which only changes the size of the program.
    """
    each = [(effect.name, p.scale(vehicle)) for effect in EFFECTS.values() for p in effect.parameters]
    active = {name for (name, _), strength in zip(each, theta, strict=True) if strength}
    kept = np.array([name in active for name, _ in each])
    names = tuple(name for name in EFFECTS if name in active)
    scale = np.array([scale for _, scale in each])
    return UniversalPlant(vehicle.build(), names, jnp.asarray(scale[kept]), jnp.asarray(theta[kept]), lap, step)


def plants_of(vehicles: Sequence[VehicleConfig], lap: float, step: float) -> UniversalPlant:
    """Build one batch of plants from `vehicles`, with the effects that their files name."""
    names = tuple(name for name in EFFECTS if any(one.effect == name for car in vehicles for one in car.effects))
    each = [(effect.name, p) for effect in effects_by_name(names) for p in effect.parameters]

    def one(vehicle: VehicleConfig) -> UniversalPlant:
        values = {(given.effect, given.parameter): given.value for given in vehicle.effects}
        scale = np.array([p.scale(vehicle) for _, p in each])
        theta = np.array([values.get((name, p.name), 0.0) for name, p in each]) / scale
        return UniversalPlant(vehicle.build(), names, jnp.asarray(scale), jnp.asarray(theta), lap, step)

    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(one, vehicles))
