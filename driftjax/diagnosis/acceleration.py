"""Estimate the rate of the speed of logs without a drive force: a Kalman smoother of the measured speed.

The estimate is the expectation given all samples of a run. Its error is independent of the estimate, as a disturbance
has to be (Berkson 1950); that of a filtered derivative is not, and weakens whatever depends on the force (errors in
variables; Fuller 1987, Sec. 1.1). The rate is a random walk, so that the estimate is that of a cubic smoothing spline
(Wahba 1978); its size and that of the noise are those of largest likelihood.

Accelerometers, which measure more precisely, are not used here: their own errors and the slope of the road are no
disturbances, and were named as effects of the car.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.diagnosis.noise import measurement_noise
from driftjax.diagnosis.outliers import without_outliers
from driftjax.diagnosis.runs import padded_size
from driftjax.logs import Run
from driftjax.parallel import call
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.single_track import G

ROOM = 256  # samples that any program has room for
JERK = 1.0  # first growth of the rate's random walk [m/s^2 in one second]
RANGE = 1e4  # times by which either size may differ from the first one


def transition_of_speed(jerk: Array, dt: float) -> tuple[Array, Array]:
    """Return the transition of (speed, rate) over a sample, and the covariance that it adds."""
    return jnp.array([[1.0, dt], [0.0, 1.0]]), jerk**2 * jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])


def filter_speed(
    sizes: Float[Array, "2"], V: Float[Array, " T"], valid: Float[Array, " T"], dt: float
) -> tuple[Array, tuple[Array, ...]]:
    """Run the Kalman filter along a speed; return minus twice its log-likelihood, and what the smoother needs.

    `sizes` are the noise of the speed [m/s] and the growth of the rate's random walk [m/s^2 in one second].
    """
    F, Q = transition_of_speed(sizes[1], dt)

    def on(carry, row):
        x, P = carry
        V, valid = row
        S, e = P[0, 0] + sizes[0] ** 2, V - x[0]
        gain = valid * P[0] / S
        cost = valid * (e**2 / S + jnp.log(S))
        x, P = x + gain * e, P - jnp.outer(gain, P[0])
        return (F @ x, F @ P @ F.T + Q), (cost, gain, valid * e / S, x, P)

    start = jnp.array([V[jnp.argmax(valid)], 0.0])
    cost, *samples = jax.lax.scan(on, (start, jnp.diag(jnp.array([2 * sizes[0], G]) ** 2)), (V, valid))[1]
    return jnp.sum(cost), tuple(samples)


def smooth_speed(
    sizes: Float[Array, "2"], V: Float[Array, " T"], valid: Float[Array, " T"], dt: float
) -> Float[Array, " T"]:
    """Return the speed given all samples [m/s], by the recursion of Bierman (1973), which inverts no matrix."""
    F, samples = transition_of_speed(sizes[1], dt)[0], filter_speed(sizes, V, valid, dt)[1]

    def back(later, sample):
        gain, weighted, x, P = sample
        before = later.at[0].add(-gain @ later - weighted)
        return F.T @ before, (x - P @ later)[0]

    return jax.lax.scan(back, jnp.zeros(2), samples, reverse=True)[1]


def _cost(logarithms: Float[Array, "2"], V: Array, valid: Array, dt: float) -> tuple[Array, Array]:
    """Return minus twice the log-likelihood of the logarithms of sizes over all runs, and its gradient."""
    total = lambda x: jnp.sum(jax.vmap(lambda V, valid: filter_speed(jnp.exp(x), V, valid, dt)[0])(V, valid))
    return jax.value_and_grad(total)(logarithms)


def _smooth_runs(sizes: Array, V: Array, valid: Array, dt: float) -> Array:
    return jax.vmap(lambda V, valid: smooth_speed(sizes, V, valid, dt))(V, valid)


def smooth_speeds(speeds: list[np.ndarray], dt: float) -> list[np.ndarray]:
    """Return for every run its speed (n,) given all of its samples [m/s]; `speeds` (n,) are NaN where not measured."""
    from scipy.optimize import minimize  # takes a second to load

    V = np.full((len(speeds), padded_size(max(map(len, speeds)), ROOM)), np.nan)
    for row, speed in zip(V, speeds, strict=True):
        row[: len(speed)] = speed
    valid = np.isfinite(V)
    V = np.where(valid, V, 0.0)
    first = np.log([measurement_noise(V[..., None], valid[..., None])[0], JERK])
    arrays = jnp.asarray(V), jnp.asarray(valid, float)

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = call(_cost, jnp.asarray(x), *arrays, dt)
        return float(value), np.asarray(slope)

    bounds = [(x - np.log(RANGE), x + np.log(RANGE)) for x in first]
    sizes = np.exp(minimize(cost, first, jac=True, method="L-BFGS-B", bounds=bounds).x)
    smooth = np.asarray(call(_smooth_runs, jnp.asarray(sizes), *arrays, dt))
    return [row[: len(speed)] for row, speed in zip(smooth, speeds, strict=True)]


def with_inertial_force(vehicle: VehicleConfig, runs: tuple[Run, ...]) -> tuple[Run, ...]:
    """Return the runs with their smoothed speed and with mass times its mean rate over the step after each sample [N].

    The force is at most friction times weight, for a car `by_acceleration`.
    """
    most = vehicle.mu * vehicle.m * G
    measured = [without_outliers(run, vehicle.a + vehicle.b).V for run in runs]

    def driven(run: Run, V: np.ndarray) -> Run:
        force = np.clip(vehicle.m * np.diff(V) / run.dt, -most, most)
        return dataclasses.replace(run, V=V, Fxr=np.append(force, force[-1]))

    return tuple(driven(run, V) for run, V in zip(runs, smooth_speeds(measured, runs[0].dt), strict=True))
