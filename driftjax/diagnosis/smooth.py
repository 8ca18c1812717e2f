"""What disturbs the car's rates, from the samples before and after: a smoother along the observer's path.

The observer's path is one the car could have taken but for the observer's corrections and disturbances. Around it the
model is linear, and state and disturbances are had by the recursions of Rauch, Tung and Striebel (1965). All pieces of
the runs go side by side.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from driftjax.diagnosis.noise import Noise
from driftjax.diagnosis.observer import START, Path, Steps, driven, kicks, transition


class Linear(NamedTuple):
    """The model along a path: w = (what the state exceeds the path's by, disturbances of the rates)."""

    F: np.ndarray  # (P, T, 6, 6) w one step later, by w
    c: np.ndarray  # (P, T, 6) less what the path itself does beyond the undisturbed car
    H: np.ndarray  # (P, T, 3, 6) what is told, by w; zero where nothing was measured
    y: np.ndarray  # (P, T, 3) measured beyond what the path would tell; zero where nothing was
    seen: np.ndarray  # (P, T, 3) 1 where measured, 0 where not
    first: np.ndarray  # (P, 6) w expected at the first sample


class Passed(NamedTuple):
    """Means and covariances of w, from the samples before one and from that one too."""

    predicted: np.ndarray  # (P, T, 6)
    spread: np.ndarray  # (P, T, 6, 6)
    filtered: np.ndarray
    filtered_spread: np.ndarray


def inside(seen: np.ndarray) -> np.ndarray:
    """Whether a sample (P, T) is one of its run rather than padding after its last measurement."""
    return np.asarray(jax.vmap(driven)(jnp.asarray(seen)))


def linear(path: Path, steps: Steps, seen: np.ndarray, left: float, dt: float) -> Linear:
    """The model along the observer's `path` with the derivatives `steps`; what tyres feel late is held to the path."""
    A, D = np.asarray(steps.A)[..., :3, :3], np.asarray(steps.D)
    e, z, before, d = (np.asarray(a) for a in (path.e, path.z, path.before, path.d))
    alive = inside(seen)
    corrected = z[..., :3] - before[..., :3]
    on = jax.vmap(jax.vmap(lambda A: transition(A, jnp.asarray(left), dt)))(jnp.asarray(A))
    F = np.where(alive[..., None, None], np.asarray(on), np.diag([1, 1, 1, left, left, left]))
    c = np.zeros((*alive.shape, 6))
    c[:, :-1, :3] = corrected[:, 1:] + np.einsum("ptij,ptj->pti", F[..., :3, 3:], d)[:, :-1]
    c[~alive] = 0.0
    H = np.concatenate([seen[..., None] * D, np.zeros_like(D)], axis=-1)
    y = seen * (e - np.einsum("ptij,ptj->pti", D, corrected))
    first = np.concatenate([-corrected[:, 0], np.zeros_like(corrected[:, 0])], axis=-1)
    return Linear(F, c, H, y, seen, first)


def growth(noise: Noise, dt: float) -> tuple[float, np.ndarray]:
    """Share of a disturbance left after one step, and the covariance (6, 6) that a step adds to that of w."""
    left = float(np.exp(-dt / noise.correlation))
    return left, np.asarray(kicks(jnp.asarray(noise.disturbance), jnp.asarray(left)))


def forwards(model: Linear, noise: Noise, dt: float) -> Passed:
    """Kalman filter of w along every piece."""
    R, Q = noise.sigma**2, growth(noise, dt)[1]
    mean = model.first
    P = np.broadcast_to(np.diag([*(START * R), *noise.disturbance**2]), (len(mean), 6, 6))
    rows = []
    for k in range(model.y.shape[1]):
        H, seen = model.H[:, k], model.seen[:, k]
        S = H @ P @ H.swapaxes(1, 2) + np.eye(3) * (seen * R + 1 - seen)[:, None, :]
        L = np.linalg.solve(S, H @ P).swapaxes(1, 2)
        better = mean + np.einsum("pij,pj->pi", L, model.y[:, k] - np.einsum("pij,pj->pi", H, mean))
        keep = np.eye(6) - L @ H
        # in this form (Joseph) rounding cannot make a variance negative where the car is unstable
        less = keep @ P @ keep.swapaxes(1, 2) + (L * (seen * R)[:, None, :]) @ L.swapaxes(1, 2)
        rows.append((mean, P, better, less))
        F = model.F[:, k]
        mean = np.einsum("pij,pj->pi", F, better) - model.c[:, k]
        P = F @ less @ F.swapaxes(1, 2) + Q
    return Passed(*(np.stack(column, axis=1) for column in zip(*rows, strict=True)))


def smooth(path: Path, steps: Steps, seen: np.ndarray, noise: Noise, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """State (P, T, 3) and disturbances of its rates (P, T, 3) from all samples of a run.

    They are expectations: where the data say little, a disturbance is told smaller than it is.
    """
    model = linear(path, steps, seen, growth(noise, dt)[0], dt)
    went = forwards(model, noise, dt)
    w = [went.filtered[:, -1]]
    for k in range(model.y.shape[1] - 2, -1, -1):
        F, P = model.F[:, k], went.filtered_spread[:, k]
        back = np.linalg.solve(went.spread[:, k + 1], F @ P).swapaxes(1, 2)
        w.append(went.filtered[:, k] + np.einsum("pij,pj->pi", back, w[-1] - went.predicted[:, k + 1]))
    found = np.stack(w[::-1], axis=1)
    return np.asarray(path.z)[..., :3] + found[..., :3], found[..., 3:]
