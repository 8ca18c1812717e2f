"""Export to CasADi: the rates of the car for acados and do-mpc, and one step of the simulator with all effects."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from driftjax.core import BadInput, Control, State
from driftjax.export.target import Format, ReducedCar, car_with, save_text
from driftjax.sim.step import LaggedState
from driftjax.sim.travel import Travel, travel
from driftjax.vehicle import VehicleConfig, actuator_lags, build_car
from driftjax.vehicle.effect import EFFECTS, Place, reference
from driftjax.vehicle.extended import LAGS, exclusion_reason

FINEST = 0.01  # longest integration step within a sample [sqrt(L/g)]
STATES = ("V", "beta", "r", "slip_f", "slip_r", "ay_roll", "t", "psi", "s", "heat", "x", "y", "distance")
DRIVEN = tuple(name for name, effect in EFFECTS.items() if effect.station != "sensor")
STEADY = tuple(name for name, effect in EFFECTS.items() if name in LAGS or not exclusion_reason(effect))


class CasadiModel(NamedTuple):
    """Function of state and input (delta [rad], Fxr [N]) in JAX, with the names of its state."""

    function: Callable[[Array, Array], Array]
    start: Float[np.ndarray, " n"]  # state of a car that rolls straight at 1 sqrt(g L), steering and drive at rest
    names: tuple[str, ...]  # of the entries of the state


def rates_model(vehicle: VehicleConfig) -> CasadiModel:
    """Return the time derivative of (V, beta, r, and the lagging delta and Fxr where the car has lags), SI."""
    car, lags = build_car(vehicle), np.asarray(actuator_lags(vehicle))
    late = [i for i in (0, 1) if lags[i] > 0]

    def function(x: Array, u: Array) -> Array:
        acting = [x[3 + late.index(i)] if i in late else u[i] for i in (0, 1)]
        dx = jnp.stack(car(State(x[0], x[1], x[2]), Control(*acting)))
        return jnp.concatenate([dx, *((u[i : i + 1] - x[3 + k : 4 + k]) / lags[i] for k, i in enumerate(late))])

    start = np.zeros(3 + len(late))
    start[0] = reference(vehicle, "speed")
    return CasadiModel(function, start, ("V", "beta", "r", *(("delta", "Fxr")[i] for i in late)))


def step_model(vehicle: VehicleConfig, h: float, lap: float) -> CasadiModel:
    """Return one step of the simulator, `h` [s], with all effects but those of the sensors.

    The state holds, after `STATES`, the memory of the actuators. `lap` [m] is the length of the road on which
    effects that depend on the place repeat.
    """
    named = {one.effect for one in vehicle.effects}
    model = car_with(vehicle, tuple(name for name in DRIVEN if name in named))
    nominal, (rest, unravel) = vehicle.build(), ravel_pytree(model.start(h))
    zero = jnp.zeros(())

    def function(x: Array, u: Array) -> Array:
        still, idle = State(zero, zero, zero), Control(zero, zero)
        now = Travel(
            State(*x[:3]), LaggedState(x[3:5], x[5]), unravel(x[13:]), Place(*x[6:10]), x[10:12], x[12], still, idle,
            jnp.zeros((0, 3)), zero,
        )  # fmt: skip
        after = travel(model, nominal, jnp.asarray(lap), now, Control(u[0], u[1]), jnp.asarray(h))
        return jnp.concatenate([
            jnp.stack(after.x), after.lagged.slip, after.lagged.ay[None], jnp.stack(after.place), after.position,
            after.distance[None], ravel_pytree(after.memory)[0],
        ])  # fmt: skip

    start = np.concatenate([np.zeros(len(STATES)), np.asarray(rest)])
    start[0] = reference(vehicle, "speed")
    return CasadiModel(function, start, (*STATES, *(f"memory_{i}" for i in range(len(rest)))))


def substeps(vehicle: VehicleConfig, dt: float) -> int:
    """Return the number of integration steps within a sample `dt` [s]."""
    return max(math.ceil(dt / (FINEST * reference(vehicle, "time"))), 1)


def write_casadi(reduced: ReducedCar, folder: Path) -> tuple[str, ...]:
    """Write rates.casadi, step.casadi (for `casadi.Function.load`) and casadi.json, which names their states."""
    try:
        import casadi as ca

        from driftjax.export.graph import to_casadi
    except ImportError:
        raise BadInput(
            "the format 'casadi' needs the extra 'casadi'; install it with pip install 'driftjax[casadi]'."
        ) from None

    full, dt = reduced.full, reduced.options.dt
    num, lap = substeps(full, dt), 1000.0
    rates, fine = rates_model(full), step_model(full, dt / num, lap)

    def graph(model: CasadiModel, name: str, output: str) -> "ca.Function":
        x, u = ca.SX.sym("x", len(model.start)), ca.SX.sym("u", 2)
        cells = to_casadi(model.function, model.start.shape, (2,))(np.array(ca.vertsplit(x)), np.array(ca.vertsplit(u)))
        return ca.Function(name, [x, u], [ca.vertcat(*cells)], ["x", "u"], [output])

    graph(rates, "rates", "x_dot").save(str(folder / "rates.casadi"))
    once, x, u = graph(fine, "fine", "x_next"), ca.MX.sym("x", len(fine.start)), ca.MX.sym("u", 2)
    after = x
    for _ in range(num):
        after = once(after, u)
    ca.Function("step", [x, u], [after], ["x", "u"], ["x_next"]).save(str(folder / "step.casadi"))
    content = {
        "u": ["delta [rad]", "Fxr [N]"],
        "rates": {"x": list(rates.names), "start": rates.start.tolist()},
        "step": {"x": list(fine.names), "start": fine.start.tolist(), "dt_s": dt, "lap_m": lap},
    }
    return ("rates.casadi", "step.casadi", save_text(folder / "casadi.json", json.dumps(content, indent=1) + "\n"))


CASADI = Format(
    "CasADi: rates (x_dot, for acados and do-mpc) and one simulator step (x_next)",
    frozenset(STEADY),
    (
        "rates holds the effects that act in steady state, and first-order lags as further states; it loses the others",
        "step holds all effects but those of the sensors, and has more states for it",
    ),
    write_casadi,
)
