"""Smooth disturbances of the car's rates along the observer's path, from all samples of a run.

The observer's path is one the car could have taken but for the observer's corrections and disturbances. Around it the
model is linear, and state and disturbances are had by the recursions of Rauch, Tung and Striebel (1965). All pieces of
the runs go side by side.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from driftjax.diagnosis.noise import Noise
from driftjax.diagnosis.observer import START_VARIANCE, Path, Steps, disturbance_covariance, samples_in_run, transition


class LinearModel(NamedTuple):
    """Linear model along a path: w = (state minus the path's, disturbances of the rates)."""

    F: np.ndarray  # (P, T, 6, 6) w one step later, by w
    c: np.ndarray  # (P, T, 6) less what the path itself does beyond the undisturbed car
    H: np.ndarray  # (P, T, 3, 6) sensor readings, by w; zero where nothing was measured
    y: np.ndarray  # (P, T, 3) measurement minus the reading on the path; zero where invalid
    valid: np.ndarray  # (P, T, 3) 1 where measured, 0 where not
    first: np.ndarray  # (P, 6) w expected at the first sample


class Filtered(NamedTuple):
    """Predicted and filtered means and covariances of w."""

    predicted: np.ndarray  # (P, T, 6)
    covariance: np.ndarray  # (P, T, 6, 6)
    filtered: np.ndarray
    filtered_covariance: np.ndarray


def linear_model(path: Path, steps: Steps, valid: np.ndarray, decay: float, dt: float) -> LinearModel:
    """Build the linear model along the observer's `path` from `steps`; lags of the tyres stay as on the path."""
    A, D = np.asarray(steps.A)[..., :3, :3], np.asarray(steps.D)
    e, z, before, d = (np.asarray(a) for a in (path.e, path.z, path.predicted, path.d))
    alive = samples_in_run(valid)
    corrected = z[..., :3] - before[..., :3]
    on = jax.vmap(jax.vmap(lambda A: transition(A, jnp.asarray(decay), dt)))(jnp.asarray(A))
    F = np.where(alive[..., None, None], np.asarray(on), np.diag([1, 1, 1, decay, decay, decay]))
    c = np.zeros((*alive.shape, 6))
    c[:, :-1, :3] = corrected[:, 1:] + np.einsum("ptij,ptj->pti", F[..., :3, 3:], d)[:, :-1]
    c[~alive] = 0.0
    H = np.concatenate([valid[..., None] * D, np.zeros_like(D)], axis=-1)
    y = valid * (e - np.einsum("ptij,ptj->pti", D, corrected))
    first = np.concatenate([-corrected[:, 0], np.zeros_like(corrected[:, 0])], axis=-1)
    return LinearModel(F, c, H, y, valid, first)


def disturbance_step(noise: Noise, dt: float) -> tuple[float, np.ndarray]:
    """Return the decay of a disturbance over one step, and the process covariance (6, 6) of w."""
    decay = float(np.exp(-dt / noise.correlation))
    return decay, np.asarray(disturbance_covariance(jnp.asarray(noise.disturbance), jnp.asarray(decay)))


def kalman_filter(model: LinearModel, noise: Noise, dt: float) -> Filtered:
    """Run the Kalman filter of w along every piece."""
    R, Q = noise.sigma**2, disturbance_step(noise, dt)[1]
    mean = model.first
    P = np.broadcast_to(np.diag([*(START_VARIANCE * R), *noise.disturbance**2]), (len(mean), 6, 6))
    rows = []
    for k in range(model.y.shape[1]):
        H, valid = model.H[:, k], model.valid[:, k]
        S = H @ P @ H.swapaxes(1, 2) + np.eye(3) * (valid * R + 1 - valid)[:, None, :]
        L = np.linalg.solve(S, H @ P).swapaxes(1, 2)
        better = mean + np.einsum("pij,pj->pi", L, model.y[:, k] - np.einsum("pij,pj->pi", H, mean))
        keep = np.eye(6) - L @ H
        # in this form (Joseph) rounding cannot make a variance negative where the car is unstable
        less = keep @ P @ keep.swapaxes(1, 2) + (L * (valid * R)[:, None, :]) @ L.swapaxes(1, 2)
        rows.append((mean, P, better, less))
        F = model.F[:, k]
        mean = np.einsum("pij,pj->pi", F, better) - model.c[:, k]
        P = F @ less @ F.swapaxes(1, 2) + Q
    return Filtered(*(np.stack(column, axis=1) for column in zip(*rows, strict=True)))


def smooth_disturbances(
    path: Path, steps: Steps, valid: np.ndarray, noise: Noise, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the state (P, T, 3) and disturbances of its rates (P, T, 3) given all samples of a run.

    They are expectations: where the data have little information, a disturbance is underestimated.
    """
    model = linear_model(path, steps, valid, disturbance_step(noise, dt)[0], dt)
    went = kalman_filter(model, noise, dt)
    w = [went.filtered[:, -1]]
    for k in range(model.y.shape[1] - 2, -1, -1):
        F, P = model.F[:, k], went.filtered_covariance[:, k]
        back = np.linalg.solve(went.covariance[:, k + 1], F @ P).swapaxes(1, 2)
        w.append(went.filtered[:, k] + np.einsum("pij,pj->pi", back, w[-1] - went.predicted[:, k + 1]))
    found = np.stack(w[::-1], axis=1)
    return np.asarray(path.z)[..., :3] + found[..., :3], found[..., 3:]
