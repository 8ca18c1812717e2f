"""Smooth disturbances of the car's rates along the observer's path, from all samples of a run.

The observer's path is one the car could have taken but for the observer's corrections and disturbances. Around it the
model is linear; state, disturbances and slow errors of the sensors follow from the recursions of Bierman (1973), which
invert no covariance of theirs. All pieces of the runs go side by side.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from driftjax.diagnosis.noise_model import (
    Decay,
    Noise,
    decay_of,
    initial_covariance,
    measurement_matrix,
    process_covariance,
    transition,
)
from driftjax.diagnosis.observer import Path, Steps, samples_in_run


class LinearModel(NamedTuple):
    """Linear model along a path: w = (state minus the path's, disturbances, slow errors)."""

    F: np.ndarray  # (P, T, 9, 9) w one step later, by w
    c: np.ndarray  # (P, T, 9) less what the path itself does beyond the undisturbed car
    H: np.ndarray  # (P, T, 3, 9) sensor readings, by w; zero where nothing was measured
    y: np.ndarray  # (P, T, 3) measurement minus the reading on the path; zero where invalid
    valid: np.ndarray  # (P, T, 3) 1 where measured, 0 where not
    first: np.ndarray  # (P, 9) w expected at the first sample


class Filtered(NamedTuple):
    """Predictions of w by the filter, and what corrects them."""

    predicted: np.ndarray  # (P, T, 9)
    covariance: np.ndarray  # (P, T, 9, 9)
    keep: np.ndarray  # (P, T, 9, 9) share of a predicted error that the update leaves
    weighted: np.ndarray  # (P, T, 9) innovations over their covariance, by w


def linear_model(path: Path, steps: Steps, valid: np.ndarray, decay: Decay) -> LinearModel:
    """Build the linear model along the observer's `path` from `steps`; lags of the tyres stay as on the path."""
    A, push, D = (np.asarray(by) for by in (steps.A[..., :3, :3], steps.push[..., :3, :], steps.D))
    e, z, before, d = (np.asarray(a) for a in (path.e, path.z, path.predicted, path.d))
    alive = samples_in_run(valid)
    corrected = z[..., :3] - before[..., :3]
    each = lambda function, *rows: np.asarray(jax.vmap(jax.vmap(function))(*map(jnp.asarray, rows)))
    F = each(lambda A, push: transition(A, push, decay), A, push)
    F = np.where(alive[..., None, None], F, np.diag([1, 1, 1, *np.asarray(decay.all)]))
    c = np.zeros((*alive.shape, 9))
    c[:, :-1, :3] = corrected[:, 1:] + np.einsum("ptij,ptj->pti", F[..., :3, 3:6], d)[:, :-1]
    c[~alive] = 0.0
    y = valid * (e + np.asarray(path.c) - np.einsum("ptij,ptj->pti", D, corrected))
    first = np.concatenate([-corrected[:, 0], np.zeros((len(c), 6))], axis=-1)
    return LinearModel(F, c, each(measurement_matrix, D, valid), y, valid, first)


def with_speed_of_path(model: LinearModel) -> LinearModel:
    """Return the linear model of a run whose speed is known, that of the path: it has no error and shows none.

    So it is where the drive force was estimated from it. The disturbance of the speed then acts through that force.
    """
    of_others = np.arange(9) > 0
    F = np.where(of_others[:, None] & of_others, model.F, 0.0)
    return LinearModel(
        F, model.c * of_others, np.where(of_others[:3, None], model.H, 0.0), model.y * of_others[:3],
        model.valid * of_others[:3], model.first * of_others,
    )  # fmt: skip


def kalman_filter(model: LinearModel, noise: Noise, dt: float) -> Filtered:
    """Run the Kalman filter of w along every piece."""
    R, Q = noise.sigma**2, np.asarray(process_covariance(noise, decay_of(noise, dt)))
    mean = model.first
    P = np.broadcast_to(np.asarray(initial_covariance(noise)), (len(mean), 9, 9))
    rows = []
    for k in range(model.y.shape[1]):
        H, valid = model.H[:, k], model.valid[:, k]
        S = H @ P @ H.swapaxes(1, 2) + np.eye(3) * (valid * R + 1 - valid)[:, None, :]
        L = np.linalg.solve(S, H @ P).swapaxes(1, 2)
        off = model.y[:, k] - np.einsum("pij,pj->pi", H, mean)
        better = mean + np.einsum("pij,pj->pi", L, off)
        keep = np.eye(9) - L @ H
        # in this form (Joseph) rounding cannot make a variance negative where the car is unstable
        less = keep @ P @ keep.swapaxes(1, 2) + (L * (valid * R)[:, None, :]) @ L.swapaxes(1, 2)
        rows.append((mean, P, keep, np.einsum("pij,pi->pj", H, np.linalg.solve(S, off[..., None])[..., 0])))
        F = model.F[:, k]
        mean = np.einsum("pij,pj->pi", F, better) - model.c[:, k]
        P = F @ less @ F.swapaxes(1, 2) + Q
    return Filtered(*(np.stack(column, axis=1) for column in zip(*rows, strict=True)))


def smooth_disturbances(
    path: Path, steps: Steps, valid: np.ndarray, noise: Noise, dt: float, *, speed_known: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return the state (P, T, 3) and disturbances of its rates (P, T, 3) given all samples of a run.

    They are expectations: where the data have little information, a disturbance is underestimated.
    """
    model = linear_model(path, steps, valid, decay_of(noise, dt))
    model = with_speed_of_path(model) if speed_known else model
    went = kalman_filter(model, noise, dt)
    later, w = np.zeros_like(went.predicted[:, 0]), []
    for k in range(model.y.shape[1] - 1, -1, -1):
        later = np.einsum("pji,pj->pi", went.keep[:, k], later) - went.weighted[:, k]
        w.append(went.predicted[:, k] - np.einsum("pij,pj->pi", went.covariance[:, k], later))
        later = np.einsum("pji,pj->pi", model.F[:, k - 1], later)
    offset = np.stack(w[::-1], axis=1)
    return np.asarray(path.z)[..., :3] + offset[..., :3], offset[..., 3:6]
