"""Kalman observer of every run: its innovations, and their derivatives by every parameter of the catalogue.

A Kalman filter of the car, of slowly varying disturbances of its rates and of slow errors of its sensors predicts each
sample from all samples and commands before it. Its innovations are white if the model is right, whatever feedback made
the commands, and they do not grow with the drift's instability (Ljung 1999, Sec. 7.4 and 13.4; Kristensen, Madsen and
Jorgensen 2004). Gains are fixed by the noise and the nominal car; parameters then enter the prediction only.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.diagnosis.noise_model import (
    Decay,
    Noise,
    decay_of,
    initial_covariance,
    process_covariance,
    transition,
)
from driftjax.sim.rollout import actuator_response, begin, move, sensor_reading
from driftjax.sim.sensitivity import move_with_derivatives
from driftjax.sim.step import slip_of
from driftjax.vehicle.effect import Place
from driftjax.vehicle.universal import Universal

TOGETHER = (
    100  # samples differentiated at once, a divisor of those of a call: fewer wait for each other, more leave the cache
)


class PaddedRun(NamedTuple):
    """One padded run: T samples, preceded by w commands."""

    commands: Float[Array, "w+T 2"]  # means over the step after each sample
    changes: Float[Array, "w+T 2"]  # of the commands over that step
    V: Float[Array, " w+T"]
    place: Place  # fields (T,)
    y: Float[Array, "T 3"]  # measured V, beta, r; zero where missing
    valid: Float[Array, "T 3"]  # 1 where measured, 0 where not
    start: Float[Array, "3"]  # V, beta, r at first, as measured


class Gains(NamedTuple):
    """Observer gains and the scale of the innovations, per sample."""

    L: Float[Array, "T 9 3"]  # update of state, disturbances and slow errors of the sensors
    whitening: Float[Array, "T 3 3"]  # whitens innovations to unit variance; rows of missing channels zero
    decay: Decay  # of disturbances and slow errors
    P: Float[Array, "T 9 9"]  # covariance of state, disturbances and slow errors after the update
    log_det: Array  # sum of the logarithms of the innovations' determinants


class Path(NamedTuple):
    """Estimates of the observer along a run, per sample."""

    e: Float[Array, "T 3"]  # innovations, zero where missing
    z: Float[Array, "T 6"]  # augmented state after the update
    predicted: Float[Array, "T 6"]  # and before it
    rates: Float[Array, "T 3 3"]  # of the state over the step before the sample, as `rollout.Moved` has them
    u: Float[Array, "T 4"]  # commands acting: means and tilts
    d: Float[Array, "T 3"]  # disturbances of the rates after the update
    c: Float[Array, "T 3"]  # slow errors of the sensors before the update
    y: Float[Array, "T 3"]  # measurements of that sample, delays removed; zero where missing
    valid: Float[Array, "T 3"]  # 1 where that was measured, 0 where not


def in_run(valid: Float[Array, "T 3"]) -> Array:
    """Return whether each sample (T,) is within the run: those after its last measurement are padding."""
    return jnp.flip(jax.lax.cummax(jnp.flip(jnp.max(valid, axis=1)))) > 0


def samples_in_run(valid: np.ndarray) -> np.ndarray:
    """Return whether each sample (P, T) is within its run rather than padding after its last measurement."""
    last_first = np.flip(np.asarray(valid).max(axis=2), axis=1)
    return np.flip(np.maximum.accumulate(last_first, axis=1), axis=1) > 0


def slip_angles(model: Universal, x: Float[Array, "3"], u: Float[Array, "4"]) -> Float[Array, "2"]:
    """Return the geometric slip angles of front and rear [rad]."""
    return slip_of(model, State(x[0], x[1], x[2]), Control(u[0], u[1]))


def set_state(model: Universal, z: Float[Array, "6"], x: Float[Array, "3"], u: Float[Array, "4"]) -> Float[Array, "6"]:
    """Return the augmented state with the car's state set to `x`; lagged slip angles keep their lag."""
    return jnp.concatenate([x, z[3:5] + slip_angles(model, x, u) - slip_angles(model, z[:3], u), z[5:]])


def with_known_speed(run: PaddedRun) -> PaddedRun:
    """Return the run with the speed that its drive force was estimated from in place of the measured one.

    It is the expectation given all measurements of the speed: these say nothing more.
    """
    V, there = run.V[-len(run.y) :], in_run(run.valid)
    replaced = lambda a, speed: jnp.asarray(a).at[..., 0].set(speed)
    y, valid = replaced(run.y, there * V), replaced(run.valid, there)
    return run._replace(y=y, valid=valid, start=replaced(run.start, V[0]))


def align_measurements(model: Universal, run: PaddedRun, dt: float) -> PaddedRun:
    """Shift every measurement back by whole steps of the sensors' delay, to the sample that it belongs to.

    Commands stay at their own time and depend on nothing measured later, so that predictions remain predictions.
    """
    run = with_known_speed(run) if model.by_acceleration else run
    T, whole = len(run.y), model.split_delays(dt)[0].astype(int)
    at = jnp.arange(T)[:, None] + whole
    of = lambda column: jnp.where(at < T, jnp.take_along_axis(column, jnp.minimum(at, T - 1), axis=0), 0.0)
    y, valid = of(run.y), of(run.valid)
    known = (whole > 0) & (jnp.min(valid[:3], axis=0) > 0)
    return run._replace(y=y, valid=valid, start=jnp.where(known, jnp.median(y[:3], axis=0), run.start))


def command_response(model: Universal, run: PaddedRun, dt: float) -> Float[Array, "w+T 4"]:
    """Return the response of the actuators to the commands of a run.

    A drive force that was estimated from the speed is as late as that: the one of a later sample acts.
    """
    delta, Fxr = run.commands.T
    if model.by_acceleration:
        late = model.sensor_delays()[0] / dt
        whole, last = jax.lax.stop_gradient(jnp.floor(late)), len(Fxr) - 1
        here = jnp.arange(len(Fxr)) + whole.astype(int)
        first, following = (Fxr[jnp.minimum(at, last)] for at in (here, here + 1))
        Fxr = first + (late - whole) * (following - first)
    return actuator_response(model, jnp.stack([delta, Fxr], axis=1), run.V, dt, run.changes)


def initial_state(model: Universal, run: PaddedRun, dt: float) -> tuple[Array, Array]:
    """Return the acting commands (T, 4), and the augmented state (6,) at the first sample."""
    u = command_response(model, run, dt)
    T, still = len(run.y), jnp.zeros((3, 3))
    x = 2 * run.start - sensor_reading(model, run.start, still, jnp.asarray(dt))  # what sensors tell so, to first order
    return u[-T:], begin(model, x, u[-T - 1], jax.tree.map(lambda a: a[0], run.place))


class ObserverRow(NamedTuple):
    """What the observer reads at one sample."""

    u: Float[Array, "4"]
    place: Place
    y: Float[Array, "3"]
    valid: Float[Array, "3"]
    L: Float[Array, "9 3"]
    alive: Array  # whether the run has not ended


class ObserverEstimate(NamedTuple):
    """Estimates before a sample is read."""

    z: Float[Array, "6"]
    d: Float[Array, "3"]
    c: Float[Array, "3"]
    rates: Float[Array, "3 3"]


class ObserverUpdate(NamedTuple):
    """What the observer makes of one sample."""

    e: Float[Array, "3"]
    z: Float[Array, "6"]  # after the update
    d: Float[Array, "3"]  # likewise
    predicted: Float[Array, "6"]  # state before the update
    rates: Float[Array, "3 3"]  # over the step before
    c: Float[Array, "3"]  # slow errors before the update


def observe_runs(
    model: Universal, theta: Float[Array, "R K"], runs: PaddedRun, L: Float[Array, "R T 9 3"], decay: Decay, dt: float
) -> Path:
    """Run the observer of gains `L` along a batch of runs, with parameters of their own, to the end of the longest."""
    aligned, rows, first = jax.vmap(lambda theta, run, L: prepare_run(model, theta, run, L, dt))(theta, runs, L)
    num = jnp.max(jnp.sum(rows.alive, axis=1))
    one = jax.vmap(lambda theta, decay, now, row: observe_sample(model, theta, decay, now, row, dt))
    start = jax.vmap(lambda now: _nothing_read(now))(first)
    updates = jax.tree.map(lambda a: jnp.repeat(a[:, None], rows.alive.shape[1], axis=1), start)

    def on(k, carry):
        now, updates = carry
        after, update = one(theta, decay, now, jax.tree.map(lambda a: a[:, k], rows))
        return after, jax.tree.map(lambda all, new: all.at[:, k].set(new), updates, update)

    e, z, d, predicted, rates, c = jax.lax.fori_loop(0, num, on, (first, updates))[1]
    return Path(e, z, predicted, rates, rows.u, d, c, aligned.y, aligned.valid)


def _nothing_read(now: ObserverEstimate) -> ObserverUpdate:
    """Return the update at a sample where nothing is read: none."""
    return ObserverUpdate(jnp.zeros(3), now.z, now.d, now.z, now.rates, now.c)


def prepare_run(
    model: Universal, theta: Array, run: PaddedRun, L: Array, dt: float
) -> tuple[PaddedRun, ObserverRow, ObserverEstimate]:
    """Return the run with its sensors' whole delays removed, its rows (T, ...), and the first estimate."""
    model = model.with_parameters(theta)
    run = align_measurements(model, run, dt)
    u, z = initial_state(model, run, dt)
    rows = ObserverRow(u, run.place, run.y, run.valid, L, in_run(run.valid))
    return run, rows, ObserverEstimate(z, jnp.zeros(3), jnp.zeros(3), jnp.zeros((3, 3)))


def observe_sample(
    model: Universal, theta: Array, decay: Decay, now: ObserverEstimate, row: ObserverRow, dt: float
) -> tuple[ObserverEstimate, ObserverUpdate]:
    """Return the estimate for the next sample and the update by this one; the padding changes nothing."""
    model, step = model.with_parameters(theta), jnp.asarray(dt)
    e = row.valid * (row.y - sensor_reading(model, now.z[:3], now.rates, step) - now.c)
    update = row.L @ e
    trend = now.d + update[3:6]
    z = set_state(model, now.z, now.z[:3] + update[:3], row.u)
    ahead = move(model, z, row.u, row.place, step, State(trend[0], trend[1], trend[2]))
    after = ObserverEstimate(ahead.z, decay.disturbance * trend, decay.slow * (now.c + update[6:]), ahead.rates)
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(row.alive, a, b), new, old)
    return keep(after, now), keep(ObserverUpdate(e, z, trend, now.z, now.rates, now.c), _nothing_read(now))


def inverse_factor(S: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the inverse of the Cholesky factor of `S`: W with W S W^T = 1, lower triangular.

    Spelled out: between calls of LAPACK for three rows, the steps of a filter take 1.7 times as long.
    """
    a = jnp.sqrt(S[0, 0])
    b, c = S[1, 0] / a, S[2, 0] / a
    d = jnp.sqrt(S[1, 1] - b**2)
    e = (S[2, 1] - b * c) / d
    f = jnp.sqrt(S[2, 2] - c**2 - e**2)
    first, second, third = 1 / a, 1 / d, 1 / f
    low, last = -b * first * second, -e * second * third
    rows = (first, 0.0, 0.0), (low, second, 0.0), (-(c * first + e * low) * third, last, third)
    return jnp.stack([jnp.stack([jnp.asarray(value) for value in row]) for row in rows])


class KalmanGain(NamedTuple):
    """Measurement update of a Kalman filter at one sample, fields as those of `Gains`."""

    L: Float[Array, "9 3"]
    whitening: Float[Array, "3 3"]
    P: Float[Array, "9 9"]
    log_det: Array


def kalman_gain(
    P: Float[Array, "9 9"], valid: Float[Array, "3"], noise: Noise, informative: Float[Array, "3"], speed_counts: Array
) -> KalmanGain:
    """Return the measurement update for the predicted covariance `P`; arguments as those of `kalman_gains`."""
    unknown = jnp.ones(9).at[jnp.array([0, 6])].set(speed_counts)  # the speed, and the slow error of its sensor
    P, R = P * jnp.outer(unknown, unknown), jnp.diag(noise.sigma**2)
    HP = valid[:, None] * (P[:3] + P[6:])  # H = valid * (1, 0, 1)
    S = valid * (HP[:, :3] + HP[:, 6:] + R) + jnp.diag(1 - valid)
    whitening = inverse_factor(S)
    scaled = whitening @ HP
    L = (scaled.T @ whitening).at[0, 0].add((1 - speed_counts) * valid[0])
    log_det = -jnp.sum(informative * jnp.log(jnp.diagonal(whitening)))
    return KalmanGain(L, informative[:, None] * whitening * valid, P - scaled.T @ scaled, log_det)


def predicted_covariance(
    P: Float[Array, "9 9"], F: Float[Array, "9 9"], Q: Float[Array, "9 9"], alive: Array
) -> Float[Array, "9 9"]:
    """Return the covariance before the next sample from that after an update; `P` where the run has ended."""
    P = jnp.where(alive, F @ P @ F.T + Q, P)
    return (P + P.T) / 2  # rounding makes it asymmetric


def kalman_gains(
    A: Float[Array, "T 3 3"], push: Float[Array, "T 3 3"], valid: Array, noise: Noise, dt: float, informative: Array
) -> Gains:
    """Return the Kalman gains of one run for this `noise`, and derivatives `A` and `push` as `transition` takes them.

    All measurements update the state, but only innovations where `informative` (T, 3) is 1 are whitened: the others are
    conditioned on. A speed that never is informative is known (`with_known_speed`): it is taken as it is, and updates
    nothing else.
    """
    decay = decay_of(noise, dt)
    speed_counts, Q = jnp.max(informative[:, 0]), process_covariance(noise, decay)

    def on(P, row):
        A, push, valid, alive, informative = row
        gain = kalman_gain(P, valid, noise, informative, speed_counts)
        return predicted_covariance(gain.P, transition(A, push, decay), Q, alive), gain

    rows = A, push, valid, in_run(valid), informative
    gains = jax.lax.scan(on, initial_covariance(noise), rows)[1]
    return Gains(gains.L, gains.whitening, decay, gains.P, jnp.sum(gains.log_det))


class Steps(NamedTuple):
    """Derivatives along a run: of every single step, and of the start."""

    A: Float[Array, "T 6 6"]  # next augmented state, by the augmented state
    C: Float[Array, "T 6 K"]  # by theta, through the car and through the commands
    D: Float[Array, "T 3 3"]  # sensor readings, by the state
    F: Float[Array, "T 3 K"]  # by theta
    slip: Float[Array, "T 2 3"]  # slip angles by the state
    push: Float[Array, "T 6 3"]  # next augmented state, by additional rates during the step
    delay: Float[Array, "T 3"]  # share of a step by which the sensors are late, whole steps apart
    valid: Float[Array, "T 3"]  # as in `Path`
    first: Float[Array, "6 K"]  # augmented state at the first sample, by theta


def augmented_change(slip: Float[Array, "2 3"], x: Float[Array, "3 n"]) -> Float[Array, "6 n"]:
    """Return the change of the augmented state by a change `x` of the state alone, without lag of the tyres."""
    return jnp.concatenate([x, slip @ x, jnp.zeros_like(x[:1])])


def propagate_derivatives(
    steps: Steps, gains: Gains, extra: Float[Array, "T 9 #K"] | None = None
) -> Float[Array, "T 3 K"]:
    """Propagate the derivatives of the innovations by theta along the observer.

    `extra` is added to the update of state, disturbances and slow errors.
    """
    extra = jnp.zeros((len(steps.A), 9, 1)) if extra is None else extra

    def on(carry, row):
        S, d, c, moved = carry
        A, C, D, F, slip, push, late, valid, L, extra, alive = row
        e = -valid[:, None] * (D @ (S[:3] - late[:, None] * moved) + F + c)
        update = L @ e + extra
        S, d, c = S + augmented_change(slip, update[:3]), d + update[3:6], c + update[6:]
        ahead = jnp.where(alive, A @ S + C + push @ d, S)
        return (ahead, gains.decay.disturbance * d, gains.decay.slow * c, ahead[:3] - S[:3]), e

    rows, still = (*steps[:8], gains.L, extra, in_run(steps.valid)), jnp.zeros_like(steps.first[:3])
    return jax.lax.scan(on, (steps.first, still, still, still), rows)[1]


def propagate_pieces(steps: Steps, gains: Gains) -> Float[Array, "P T 3 K"]:
    """Apply `propagate_derivatives` to pieces, the leading axis."""
    return jax.vmap(propagate_derivatives)(steps, gains)


def innovations_with_gains(steps: Steps, e: Float[Array, "T 3"], L: Array, gains: Gains) -> Array:
    """Return the innovations (T, 3) under `gains`, to first order, from those under the gains `L`."""
    still = jnp.zeros((6, 1))
    old = jnp.einsum("tij,tj->ti", L, e)
    steps = steps._replace(C=jnp.broadcast_to(still, (len(e), 6, 1)), F=-e[:, :, None], first=still)
    return propagate_derivatives(steps, gains, -old[:, :, None])[:, :, 0]


class SampleDerivatives(NamedTuple):
    """Derivatives at single samples, as in `Steps`, separately by the commands and by theta at fixed commands."""

    A: Float[Array, "n 6 6"]
    by_u: Float[Array, "n 6 4"]
    by_theta: Float[Array, "n 6 K"]
    D: Float[Array, "n 3 3"]
    F: Float[Array, "n 3 K"]
    slip: Float[Array, "n 2 3"]
    push: Float[Array, "n 6 3"]
    delay: Float[Array, "n 3"]


def sample_derivatives(model: Universal, theta: Array, path: Path, place: Place, dt: float) -> SampleDerivatives:
    """Compute the derivatives at single samples of `path` (leading axis)."""
    car, step = model.with_parameters(theta), jnp.asarray(dt)
    late_by = car.split_delays(step)[1].sensor_delays() / step

    def one(at: tuple[Path, Place]):
        path, place = at
        by = move_with_derivatives(car, path.z, path.u, place, step, path.d).by
        A, by_u, push, by_theta = jnp.split(by, (6, 10, 13), axis=1)
        sensed = lambda x, p: sensor_reading(model.with_parameters(p), x, path.rates, step)
        D, F = jax.jacrev(sensed, (0, 1))(path.predicted[:3], theta)
        slip = jax.jacrev(lambda x: slip_angles(car, x, path.u))(path.z[:3])
        return SampleDerivatives(A, by_u, by_theta, D, F, slip, push, late_by)

    return jax.lax.map(one, (path, place), batch_size=TOGETHER)


def command_derivatives(model: Universal, theta: Array, run: PaddedRun, dt: float) -> tuple[Array, Array]:
    """Return the derivatives by theta of the acting commands (T, 4, K) and of the initial augmented state (6, K)."""
    moves = lambda effect: effect.station == "command" or (model.by_acceleration and effect.sensor_delay)
    columns = np.flatnonzero([moves(effect) for effect in model.effects for _ in effect.parameters])
    run = align_measurements(model.with_parameters(theta), run, dt)
    value = lambda p: initial_state(model.with_parameters(p), run, dt)
    each = jax.vmap(lambda d: jax.jvp(lambda p: value(p)[0], (theta,), (d,))[1])(jnp.eye(len(theta))[columns])
    by_u = jnp.zeros((len(run.y), 4, len(theta))).at[:, :, columns].set(jnp.moveaxis(each, 0, -1))
    # one evaluation of the car: forward mode compiles in two thirds of the time
    return by_u, jax.jacfwd(lambda p: value(p)[1])(theta)
