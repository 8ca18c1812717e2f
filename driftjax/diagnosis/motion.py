"""Compare the measured motion with pose and accelerations: sensor errors, without any parameter of the car.

Heading and position are integrals of V, beta and r, and accelerometers measure their rates: psi' = r,
x' = V cos(psi + beta), ax = vx' - r vy and ay = vy' + r vx hold for any car (Ryu and Gerdes 2004; Bevly, Ryu and
Gerdes 2006). The changes over windows of time are compared, so that nothing noisy is differentiated. Errors of pose
and accelerations themselves, such as biases of the accelerometers, are projected out.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.diagnosis.noise import PRIOR, robust_deviation
from driftjax.diagnosis.observer import PaddedRun, align_measurements
from driftjax.diagnosis.runs import (
    FURTHER,
    MeasuredMotion,
    Pieces,
    batches,
    concatenate_trees,
    padded_size,
    take,
    theta_of_pieces,
)
from driftjax.parallel import call
from driftjax.sim.record import road_acceleration
from driftjax.vehicle.universal import Universal

BATCH = 16  # pieces compared at once
SPAN = 0.5  # length of a window [sqrt(L/g)]
ROOM = 128  # windows that any program has room for
INVERSIONS = 3  # fixed-point iterations for the motion that sensors with given errors measured
ITERATIONS = 4  # Gauss-Newton steps on the errors of sensors, for the noise
OUTLIER = 6.0  # standard deviations from which a window is an outlier
TOO_GOOD = 0.5  # noise over that of V, beta, r below which a channel was computed from them and says nothing new
REWEIGHTINGS = 3  # of the residuals by their noise in one step
TINY = 1e-12  # where a scale is zero
INDEPENDENT = 1e-9  # singular value, over the largest, from which an own error of the channels is distinguishable


class MotionResiduals(NamedTuple):
    """Differences of n windows in heading rate [rad/s], velocity along and across [m/s], ax and ay [m/s^2]."""

    e: Array  # (n, 5) measured less computed from V, beta and r
    by_sensors: Array  # (n, 5, Q) derivatives by errors of the further channels themselves
    valid: Array  # (n, 5) whether all was measured


class MotionNoise(NamedTuple):
    """Noise of the windows."""

    sigma: np.ndarray  # (5,) standard deviation, of means over a block where windows depend on each other
    used: np.ndarray  # (P, n, 5) windows that count, or (5,) channels


def central_difference_of_first(f: Array, num: Array) -> Array:
    """Return the central difference of the first `num` values of `f` (n,); later values are meaningless."""
    return jnp.asarray(jnp.gradient(f)).at[num - 1].set(f[num - 1] - f[num - 2])


def window_size(model: Universal, dt: float) -> int:
    """Return the number of samples from the start of a window to its end."""
    return max(round(SPAN * float(model.base.unit_time) / dt), 2)


def local_lines(f: Float[Array, " T"], valid: Float[Array, " T"], half: Array) -> tuple[Array, Array]:
    """Return value and slope (T,), per sample, of the line through the valid values up to `half` samples either way."""
    k = jnp.arange(len(f)) - len(f) / 2
    moments = valid * jnp.stack([jnp.ones_like(k), k, k**2, f, k * f])
    sums = jnp.pad(jnp.cumsum(moments, axis=1), ((0, 0), (1, 0)))
    first, last = (jnp.clip(jnp.arange(len(f)) + end, 0, len(f)) for end in (-half, half + 1))
    num, at, squares, value, product = sums[:, last] - sums[:, first]
    several, mean = num > 1, at / jnp.maximum(num, 1)
    slope = jnp.where(several, (product - mean * value) / jnp.where(several, squares - mean * at, 1.0), 0.0)
    return value / jnp.maximum(num, 1) + slope * (k - mean), slope


def line_size(W: Array | int) -> Array:
    """Return how many samples to either side of one belong to its line, for windows of `W` samples."""
    return jnp.maximum(jnp.asarray(W) // 4, 1)


def blend_lines(f: Array, slope: Array, share: Array) -> Array:
    """Return `f` (T,) a `share` of a sample later: the mean of the lines at both samples, weighted by nearness."""
    following, its_slope = (jnp.append(a[1:], a[-1]) for a in (f, slope))
    return (1 - share) * (f + share * slope) + share * (following - (1 - share) * its_slope)


def true_motion(model: Universal, run: PaddedRun, W: Array, dt: float) -> tuple[State, Array]:
    """Return the motion (T,) behind the measured `run`, sensor errors removed, and where it is known (T, 3).

    Values are those of local lines, and change continuously with a delay. Single samples would each bring their noise,
    so that residuals jumped wherever a delay is a whole number of samples, and a search ended there.
    """
    aligned, half = align_measurements(model, run, dt), line_size(W)
    share = model.split_delays(dt)[1].sensor_delays() / dt
    lines = [local_lines(y, valid, half) for y, valid in zip(aligned.y.T, aligned.valid.T, strict=True)]
    y = State(*(blend_lines(*line, late) for line, late in zip(lines, share, strict=True)))
    sensors, x, still = model.without_delays(), y, jax.tree.map(jnp.zeros_like, y)
    for _ in range(INVERSIONS):
        x = jax.tree.map(lambda y, x, read: y - (read - x), y, x, sensors.sense(x, still))
    beside = jnp.pad(aligned.valid, ((1, 1), (0, 0)), mode="edge")
    return x, aligned.valid * beside[:-2] * beside[2:]


class _Windows(NamedTuple):
    """Consecutive windows of `W` samples: `num` rows, of which the run of `last` + 1 samples may hold fewer."""

    W: Array
    num: int
    last: int
    duration: Array  # of a window [s]
    starts: Array  # (num,) first samples
    ends: Array  # (num,) those of the next windows

    def change(self, f: Array) -> Array:
        """Return the mean rate of change of `f` (samples,) in every window."""
        return (f[self.ends] - f[self.starts]) / self.duration

    def mean(self, f: Array) -> Array:
        """Return the mean of `f` (samples,) in every window, by the trapezoidal rule."""
        return jax.ops.segment_sum((f[1:] + f[:-1]) / 2, jnp.arange(self.last) // self.W, self.num) / self.W

    def slope(self, f: Array) -> Array:
        """Return the change of `f` (num,) from window to window."""
        return central_difference_of_first(f, self.last // self.W)


def _consecutive(W: Array, num: int, last: int, duration: Array) -> _Windows:
    """Return the windows of a run of `last` + 1 samples."""
    starts, ends = (jnp.minimum(k * W, last) for k in (jnp.arange(num), jnp.arange(num) + 1))
    return _Windows(W, num, last, duration, starts, ends)


def motion_residuals(
    model: Universal, theta: Float[Array, " K"], run: PaddedRun, motion: MeasuredMotion, W: Array, room: int, dt: float
) -> MotionResiduals:
    """Compare one run with its further channels over consecutive windows of `W` samples.

    There are `room` rows; those from the first window on that the run does not hold whole count for nothing.
    """
    model = model.with_parameters(theta)
    (V, beta, r), known = true_motion(model, run, W, dt)
    windows = _consecutive(W, room, len(V) - 1, W * dt)
    n, T, change, mean, slope = room, windows.duration, windows.change, windows.mean, windows.slope
    psi, x, y, ax, ay = motion.y.T
    vx, vy, turned = V * jnp.cos(beta), V * jnp.sin(beta), psi + beta
    across = jnp.stack([-V * jnp.sin(turned), V * jnp.cos(turned)])  # the velocity turned left by 90 degrees
    middle = psi[jnp.minimum(windows.starts + W // 2, windows.last)]
    body = lambda f: jnp.stack([f[0] * jnp.cos(middle) + f[1] * jnp.sin(middle),
                                f[1] * jnp.cos(middle) - f[0] * jnp.sin(middle)])  # fmt: skip
    moved = body(jnp.stack([change(x) - mean(across[1]), change(y) + mean(across[0])]))
    along, left = change(vx) - mean(r * vy), change(vy) + mean(r * vx)
    still = Control(jnp.zeros_like(V), jnp.zeros_like(V))
    road = road_acceleration(model, State(V, beta, r), still, run.place)
    turn = jnp.angle(jnp.exp(1j * (change(psi) - mean(r)) * T)) / T
    e = jnp.stack([turn, *moved, mean(ax) - along + mean(road[0]), mean(ay) - left + mean(road[1])], axis=1)
    sideways, late = (body(jnp.stack([mean(f * across[0]), mean(f * across[1])])) for f in (1.0, r))
    ahead = body(jnp.stack([change(across[1]), -change(across[0])]))
    arms = [body(jnp.stack([change(jnp.cos(psi)), change(jnp.sin(psi))])),
            body(jnp.stack([-change(jnp.sin(psi)), change(jnp.cos(psi))]))]  # fmt: skip
    zero, one, jerk = jnp.zeros(n), jnp.ones(n), [slope(a) / T for a in (along, left)]
    bend = lambda f: slope(slope(f))
    own = [
        [-change(r), *late, zero, zero],  # delay of the heading
        [zero, *-sideways, zero, zero],  # offset of the heading
        [zero, *-ahead, zero, zero],  # delay of the position
        *([zero, *arm, zero, zero] for arm in arms),  # place on the car whose position is measured
        [zero, zero, zero, one, zero], [zero, zero, zero, zero, one],  # biases of the accelerometers, level road
        [zero, zero, zero, along, zero], [zero, zero, zero, zero, left],  # their scales, roll and pitch among them
        [zero, zero, zero, left, -along],  # their angle to the car
        [zero, zero, zero, -jerk[0], -jerk[1]],  # their delay
        [zero, zero, zero, -mean(r**2), change(r)], [zero, zero, zero, -change(r), -mean(r**2)],  # their place
        # smoothing of either side, and the second order of a delay
        [bend(mean(r)), zero, zero, zero, zero], [zero, bend(mean(vx)), zero, zero, zero],
        [zero, zero, bend(mean(vy)), zero, zero], [zero, zero, zero, bend(along), bend(left)],
    ]  # fmt: skip
    of_sensors = jnp.stack([jnp.stack(column, 1) for column in own], 2)
    return MotionResiduals(e, of_sensors, _whole_windows(known, motion, W, n))


def _whole_windows(known: Array, motion: MeasuredMotion, W: Array, n: int) -> Array:
    """Return the windows (n, 5) in which every value that a channel is compared with was measured."""
    begin = jnp.arange(n) * W

    def complete(f):
        gaps = jnp.concatenate([jnp.zeros((1, f.shape[1])), jnp.cumsum(1 - f, axis=0)])
        lost = gaps[jnp.minimum(begin + W + 1, len(f))] - gaps[jnp.minimum(begin, len(f))]
        return jnp.where((begin + W < len(f))[:, None] & (lost == 0), 1.0, 0.0)

    state, (psi, x, y, ax, ay) = complete(known), complete(motion.valid).T
    moving = jnp.min(state, axis=1)
    placed = moving * psi * x * y
    return jnp.stack([state[:, 2] * psi, placed, placed, moving * ax, moving * ay], axis=1)


def batched_residuals(model, theta, runs, motion, W, room, dt):
    """Apply `motion_residuals` to a batch of pieces, with parameters `theta` (B, K) of their own."""
    return eqx.filter_vmap(motion_residuals, in_axes=(None, 0, 0, 0, None, None, None))(
        model, theta, runs, motion, W, room, dt
    )  # fmt: skip


def kinematic_columns(model: Universal) -> np.ndarray:
    """Return the indices of the parameters of sensors and road, on which alone the residuals depend."""
    return np.flatnonzero([effect.kinematic for effect in model.effects for _ in effect.parameters])


def batched_derivatives(model, theta, runs, motion, W, room, dt):
    """Return the derivatives (B, n, 5, K) by theta of the pose and accelerations predicted from V, beta and r."""
    columns, num = kinematic_columns(model), theta.shape[-1]
    value = lambda theta: batched_residuals(model, theta, runs, motion, W, room, dt).e
    along = lambda d: jax.jvp(value, (theta,), (jnp.broadcast_to(d, theta.shape),))[1]
    by = jax.vmap(along, out_axes=-1)(jnp.eye(num)[columns])
    return jnp.zeros((*by.shape[:-1], num)).at[..., columns].set(-by)


def piece_residuals(model: Universal, data: Pieces, theta: np.ndarray) -> MotionResiduals:
    """Compare all pieces with their further channels; leading axes (P, n)."""
    return _map_windows(batched_residuals, model, data, theta_of_pieces(data, theta), np.arange(len(data.run)))


def piece_derivatives(model: Universal, data: Pieces, theta: np.ndarray) -> np.ndarray:
    """Return the derivatives (P, n, 5, K) of the computed motion of all pieces by theta."""
    return _map_windows(batched_derivatives, model, data, theta_of_pieces(data, theta), np.arange(len(data.run)))


def _map_windows(function, model: Universal, data: Pieces, theta: np.ndarray, piece: np.ndarray):
    """Apply `function` with the parameters `theta` (R, K) to the pieces with the numbers `piece` (R,), in batches.

    The array of windows has a padded size; those that exist are returned.
    """
    W = window_size(model, data.dt)
    n = (data.size - 1) // W
    room, parts = padded_size(n, ROOM), []
    for batch in batches(len(piece), BATCH):
        runs, motion = take((data.padded, data.motion), piece[batch])
        parts.append(call(function, model, jnp.asarray(theta[batch]), runs, motion, jnp.asarray(W), room, data.dt))
    return jax.tree.map(lambda a: a[:, :n], concatenate_trees(parts, len(piece)))


def window_ends(model: Universal, data: Pieces) -> slice:
    """Return the samples at which the windows of a piece end."""
    W = window_size(model, data.dt)
    return slice(W, W * ((data.size - 1) // W) + 1, W)


def window_blocks(model: Universal, data: Pieces) -> np.ndarray:
    """Return the number (P, n) of the block in which each window ends."""
    return data.block[:, window_ends(model, data)]


def estimate_motion_noise(
    model: Universal, data: Pieces, start: np.ndarray, limits: tuple[np.ndarray, np.ndarray], active: np.ndarray,
    sigma: np.ndarray,
) -> MotionNoise:  # fmt: skip
    """Estimate the noise of the windows as the part that no sensor error explains; `sigma` (3,) is that of V, beta, r.

    Errors of the sensors and of the further channels are fitted together, outliers are left out. A channel that
    agrees better than the noise of V, beta and r lets it was computed from them, and is not used.
    """
    theta, left, used = start, np.zeros(0), np.zeros(0, bool)
    for _ in range(ITERATIONS):
        residuals = piece_residuals(model, data, theta)
        J = np.where(active, np.asarray(piece_derivatives(model, data, theta)), 0.0)
        e, own = np.asarray(residuals.e), np.asarray(residuals.by_sensors)
        step, left, used = robust_step(e, J, own, np.asarray(residuals.valid) > 0, (theta - start) / PRIOR)
        theta = np.clip(theta + step, *limits)
    noise = np.array([robust_scale(left[..., c][used[..., c]]) for c in range(len(FURTHER))])
    noise *= dependence(np.where(used, left / noise, 0.0), used, window_blocks(model, data))
    used &= noise > TOO_GOOD * noise_of_sensors(data, window_size(model, data.dt), sigma)
    return MotionNoise(noise, used)


def robust_scale(values: np.ndarray) -> float:
    """Return the `robust_deviation` of `values`, to divide by: never zero, and 1 without any."""
    return max(robust_deviation(values), TINY) if len(values) else 1.0


def robust_step(
    e: np.ndarray, J: np.ndarray, own: np.ndarray, valid: np.ndarray, moved: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit residuals (P, n, 5) by sensor errors, with derivatives (P, n, 5, K), and by `own` errors, robust to outliers.

    Return the step (K,) from the present errors, which are `moved` by so many standard deviations of their prior, the
    residuals left and which are no outliers.
    """
    K, Q, used, left = J.shape[-1], own.shape[-1], valid, e
    x, size = np.zeros(K + Q), np.ones(Q)
    for _ in range(REWEIGHTINGS):
        scale = np.array([robust_scale(left[..., c][valid[..., c]]) for c in range(len(FURTHER))])
        used = valid & (np.abs(left) < OUTLIER * scale)
        A = (np.concatenate([J, own], axis=-1) / scale[:, None])[used]
        size = np.maximum(np.sqrt((A[:, K:] ** 2).sum(axis=0)), TINY)
        A[:, K:] /= size
        ridge = np.diag(np.r_[np.full(K, 1 / PRIOR**2), np.full(Q, INDEPENDENT)])
        rest = A.T @ (e / scale)[used] - np.r_[moved / PRIOR, np.zeros(Q)]
        x = np.linalg.solve(A.T @ A + ridge, rest)
        left = e - J @ x[:K] - own @ (x[K:] / size)
    return x[:K], left, used


def dependence(e: np.ndarray, used: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Return the standard deviation (5,) of block sums of `e` (P, n, 5), over that of independent noise; at least 1."""
    sums, num = np.zeros((2, block.max() + 1, e.shape[-1]))
    np.add.at(sums, block, e)
    np.add.at(num, block, used)
    return np.sqrt(np.maximum((sums**2).sum(axis=0) / np.maximum(num.sum(axis=0), 1), 1.0))


def noise_of_sensors(data: Pieces, W: int, sigma: np.ndarray) -> np.ndarray:
    """Return the noise (5,) that the noise `sigma` of V, beta and r alone gives the residuals of windows."""
    V = np.asarray(data.padded.y)[..., 0][np.asarray(data.padded.valid)[..., 0] > 0]
    velocity = np.array([sigma[0], np.sqrt(np.mean(V**2)) * sigma[1]])
    ends = np.sqrt(2 / (2 * float(line_size(W)) + 1)) / (W * data.dt)
    return np.r_[sigma[2] / np.sqrt(W), velocity / np.sqrt(W), ends * velocity]


def orthonormal(own: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (P, n, 5, q) of the span of the columns of `own` (P, n, 5, Q)."""
    A = own.reshape(-1, own.shape[-1])
    size = np.sqrt((A**2).sum(axis=0))
    U, s, _ = np.linalg.svd(A[:, size > 0] / size[size > 0], full_matrices=False)
    return U[:, s > INDEPENDENT * s.max(initial=0.0)].reshape(*own.shape[:-1], -1)


def whitened_residuals(
    model: Universal, data: Pieces, thetas: np.ndarray, noise: MotionNoise
) -> list[tuple[np.ndarray, int]]:
    """Return the whitened residuals (P, T, 5) of every car of `thetas` (R, K), and how many windows it lacks.

    They stand at the ends of windows. What the further channels may err by themselves is projected out at each theta
    (Golub and Pereyra 1973). Cars with the same sensors and road share their residuals.
    """
    _, first, which = np.unique(thetas[:, kinematic_columns(model)], axis=0, return_index=True, return_inverse=True)
    P = len(data.run)
    row = np.arange(P * len(first))
    residuals = _map_windows(batched_residuals, model, data, thetas[first[row // P]], row % P)
    each = [_projected(take(residuals, slice(k, k + P)), model, data, noise) for k in range(0, len(row), P)]
    return [each[k] for k in which.reshape(-1)]


def _projected(
    residuals: MotionResiduals, model: Universal, data: Pieces, noise: MotionNoise
) -> tuple[np.ndarray, int]:
    e, own, there = _whitened(residuals, noise)
    e = e - np.einsum("pnic,c->pni", own, np.einsum("pnic,pni->c", own, e))
    return _at_ends(e, model, data), int(noise.used.sum() - there.sum())


def whitened_motion_derivatives(
    model: Universal, data: Pieces, theta: np.ndarray, noise: MotionNoise, active: np.ndarray
) -> np.ndarray:
    """Return the whitened derivatives (P, T, 5, K) of the predictions by the `active` parameters.

    Those of the projection are left out (Kaufman 1975).
    """
    _, own, there = _whitened(piece_residuals(model, data, theta), noise)
    J = np.asarray(piece_derivatives(model, data, theta)) / noise.sigma[:, None]
    J = np.where(there[..., None] & active, J, 0.0)
    J -= np.einsum("pnic,ck->pnik", own, np.einsum("pnic,pnik->ck", own, J, optimize=True), optimize=True)
    return _at_ends(J, model, data)


def _whitened(residuals: MotionResiduals, noise: MotionNoise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return whitened residuals (P, n, 5), a basis (P, n, 5, q) of own errors, and which windows there are."""
    there = noise.used & (np.asarray(residuals.valid) > 0)
    e = np.where(there, np.asarray(residuals.e) / noise.sigma, 0.0)
    return (
        e,
        orthonormal(np.where(there[..., None], np.asarray(residuals.by_sensors) / noise.sigma[:, None], 0.0)),
        there,
    )


def _at_ends(windows: np.ndarray, model: Universal, data: Pieces) -> np.ndarray:
    """Place values of windows (P, n, ...) at the samples (P, T, ...) at which these end, zero elsewhere."""
    whole = np.zeros((len(windows), data.size, *windows.shape[2:]))
    whole[:, window_ends(model, data)] = windows
    return whole
