"""Roll-outs of the plant that the tests share, so that they share the compiled programs too."""

import equinox as eqx
import jax
import jax.numpy as jnp

from driftjax.core import Control
from driftjax.vehicle import DoubleTrack, Motion, PlantState

SUBSTEPS = 10


def drive(car: DoubleTrack, start: PlantState, delta, Fxr, dt) -> tuple[PlantState, Motion]:
    """States and motions after each command, `dt` apart, of ten substeps."""

    def step(state, command):
        state = car.advance(state, command, dt, SUBSTEPS)
        return state, (state, car.motion(state, command))

    return jax.lax.scan(step, start, Control(jnp.asarray(delta), jnp.asarray(Fxr)))[1]


_compiled = eqx.filter_jit(drive)


def run(car: DoubleTrack, start: PlantState, delta, Fxr, dt) -> tuple[PlantState, Motion]:
    """`drive`, compiled once for each number of commands: everything else goes in as strongly typed arrays."""
    strong = lambda leaf: jnp.asarray(leaf, float).astype(float)
    return _compiled(car, jax.tree.map(strong, start), strong(delta), strong(Fxr), strong(dt))


def last(states: PlantState) -> PlantState:
    """State at the end of a run."""
    return jax.tree.map(lambda leaf: leaf[-1], states)


def energy(car: DoubleTrack, state: PlantState):
    """Kinetic energy of body, wheels and drive [J]."""
    chassis, wheels = car.chassis, car.wheels
    body = chassis.m * (state.vx**2 + state.vy**2) + chassis.Iz * state.r**2
    rear = (state.omega[..., 2] + state.omega[..., 3]) / 2
    return (body + wheels.inertia * (state.omega**2).sum(-1) + wheels.drive_inertia * rear**2) / 2
