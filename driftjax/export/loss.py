"""Measure the loss of a target: predict with and without the effects that it cannot represent."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import BadInput
from driftjax.export.target import car_with
from driftjax.logs import Log, Run
from driftjax.manoeuvres.library import MANOEUVRES
from driftjax.parallel import call
from driftjax.sim.rollout import SETTLE, actuator_response, begin, move, sensor_reading
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import Place, reference
from driftjax.vehicle.universal import Universal

STANDARD = ("slalom", "throttle_steps")  # manoeuvres without a log
LENGTH, SAMPLE = 10.0, 0.02  # of each, and of its samples [sqrt(L/g)]
HORIZON, EVERY = 2.0, 1.0  # of predictions on a log, and between their starts [sqrt(L/g)]
CHANNELS = ("V", "beta", "r")
OPTIONAL_NAMES = {"beta": "sideslip beta", "r": "yaw rate r", "Fxr": "drive force Fxr"}  # channels that a log may lack


class Window(NamedTuple):
    """Commands of a prediction, and the history before it."""

    commands: Float[Array, "w 2"]  # from SETTLE before the start to the horizon
    changes: Float[Array, "w 2"]  # of the commands over the step after each sample
    V: Float[Array, " w"]
    y: Float[Array, "n 3"]  # measured V, beta, r from the start on; the standard manoeuvre has its start only
    place: Place  # fields (n,)


class Loss(NamedTuple):
    """Root-mean-square prediction errors of V [m/s], beta [rad] and r [rad/s]."""

    of: str  # the log, or the standard manoeuvre
    horizon_s: float
    with_them: tuple[float, ...] | None  # of the car with all its effects, against the log; None without a log
    without_them: tuple[float, ...]  # of the car without those the target cannot hold, against the log or that car


def loss(full: VehicleConfig, reduced: VehicleConfig, log: Log | None = None) -> Loss:
    """Measure the prediction error that `reduced`, which lacks some effects of `full`, adds.

    On a log: errors at a horizon of 2 sqrt(L/g), from starts 1 sqrt(L/g) apart, of predictions that start at the
    measured state. Without one: how far the two cars get apart in an open-loop slalom and in steps of drive and brake.
    Raises `BadInput` for a run without sideslip or drive force.
    """
    unit, names = reference(full, "time"), tuple({one.effect for one in full.effects})
    if log is None:
        dt = SAMPLE * unit
        windows, num = [_standard(full, name, dt) for name in STANDARD], round(LENGTH / SAMPLE)
    else:
        _require_channels(log)
        dt = log.runs[0].dt
        num = max(round(HORIZON * unit / dt), 1)
        windows = [window for run in log.runs for window in _of_run(run, num, max(round(EVERY * unit / dt), 1), unit)]
    if not windows:
        raise BadInput(f"log: no run has {num * dt:.3g} s of samples with a measured start; give longer runs.")
    stacked = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *windows)
    predictions = [np.asarray(call(_predict, car_with(car, names), stacked, dt)) for car in (full, reduced)]
    if log is None:
        return Loss("standard manoeuvre", num * dt, None, _rms(predictions[1] - predictions[0]))
    errors = [(one - np.asarray(stacked.y)[:, 1:])[:, -1:] for one in predictions]
    return Loss("log", num * dt, _rms(errors[0]), _rms(errors[1]))


def _require_channels(log: Log) -> None:
    for run in log.runs:
        for channel, words in OPTIONAL_NAMES.items():
            if not np.isfinite(getattr(run, channel)).any():
                raise BadInput(
                    f"log, run '{run.name}': has no {words}, which the loss of an export is measured with; "
                    "give runs that have it (--log, --runs), or leave out --log."
                )


def _rms(off: np.ndarray) -> tuple[float, ...]:
    off = off.copy()
    off[..., 1] = np.angle(np.exp(1j * off[..., 1]))
    return tuple(float(value) for value in np.sqrt(np.nanmean(off**2, axis=(0, 1))))


def _predict(model: Universal, windows: Window, dt: float) -> Float[Array, "S n 3"]:
    def one(window: Window) -> Array:
        num = len(window.y) - 1
        inputs = actuator_response(model, window.commands, window.V, dt, window.changes)
        before, u = inputs[-num - 1], inputs[-num:]
        place = lambda k: jax.tree.map(lambda a: a[k], window.place)

        def on(z: Array, k: Array) -> tuple[Array, Array]:
            after = move(model, z, u[k], place(k), jnp.asarray(dt))
            return after.z, sensor_reading(model, after.z[:3], after.rates, jnp.asarray(dt))

        return jax.lax.scan(on, begin(model, window.y[0], before, place(0)), jnp.arange(num))[1]

    return jax.vmap(one)(windows)


def _standard(vehicle: VehicleConfig, name: str, dt: float) -> Window:
    num = round(LENGTH / SAMPLE)
    plan = MANOEUVRES[name](vehicle, np.random.default_rng(0), np.arange(num + 1) * dt)
    x, u = np.asarray(plan.x_ref), np.asarray(plan.u_ref)
    run = Run(name, np.arange(num + 1) * dt, x[:, 0], x[:, 1], x[:, 2], u[:, 0], u[:, 1], dt)
    return _window(run, 0, num)


def _of_run(run: Run, num: int, every: int, unit: float) -> list[Window]:
    measured = np.isfinite(run.V) & np.isfinite(run.beta) & np.isfinite(run.r)
    return [_window(run, k, num) for k in range(0, len(run.t) - num, every) if measured[k] and measured[k + num]]


def _window(run: Run, start: int, num: int) -> Window:
    """Return the window of `num` steps from sample `start`; before the run its first command is held."""
    warm = round(SETTLE / run.dt)
    at = np.arange(start - warm, start + num)
    rows = np.clip(at, 0, None)
    changes = np.where(at[:, None] < 0, 0.0, run.command_changes[rows])
    V = np.interp(run.t, run.t[np.isfinite(run.V)], run.V[np.isfinite(run.V)])
    r = np.where(np.isfinite(run.r), run.r, 0.0)
    here = slice(start, start + num + 1)
    psi = run.extra.get("psi", np.cumsum(r) * run.dt)[here]
    s = run.extra.get("s", np.zeros(len(run.t)))
    place: list[Any] = [run.t[here], psi, (s / max(float(np.nanmax(s)), 1e-9))[here], np.zeros(num + 1)]
    y = np.stack([run.V, run.beta, run.r], axis=1)[here]
    parts: list[Any] = [np.stack([run.delta, run.Fxr], axis=1)[rows], changes, V[rows], y, Place(*place)]
    return Window(*parts)
