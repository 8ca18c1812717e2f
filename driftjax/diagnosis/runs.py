"""Run the observer over all runs of a data set, in a few compiled programs of fixed shapes."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import State
from driftjax.diagnosis.channel_estimates import TURNED, has_sideslip, integrated_yaw_rate, sideslip
from driftjax.diagnosis.extended_filter import filter_runs
from driftjax.diagnosis.noise_model import Decay, Noise
from driftjax.diagnosis.observer import (
    Gains,
    PaddedRun,
    Path,
    SampleDerivatives,
    Steps,
    command_derivatives,
    kalman_gains,
    observe_runs,
    propagate_pieces,
    sample_derivatives,
    samples_in_run,
)
from driftjax.diagnosis.outliers import without_outliers
from driftjax.logs import Run
from driftjax.logs.sampling import fill_gaps
from driftjax.parallel import call
from driftjax.sim.rollout import SETTLE
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import Place
from driftjax.vehicle.effect.flow import heat_rate
from driftjax.vehicle.single_track import G
from driftjax.vehicle.universal import Universal

PIECE_LENGTH, SHORT_PIECE_LENGTH = 1000, 250  # samples of one piece: a longer run is followed piece by piece
WORTHWHILE = 0.6  # share of the padded samples that short pieces may leave at most: each begins with a new observer
BATCH_SIZE = 2  # pieces followed at once: more take longer on a CPU where runs are few
LANES = 16  # pieces that the observer follows at once: each costs a third of one alone
SAMPLES = 400  # samples differentiated in one call: the last one is filled up
BLOCK = 1.0  # length of the blocks in which innovations may depend on each other [s]
ERROR_BLOCK = 2.0  # and errors of predictions and smoothed forces [s]
UNKNOWN_START = 2.0  # time in which the observer finds a sideslip that is not measured [sqrt(L/g)]
STARTS = np.linspace(-0.98, 0.98, LANES - 1)  # sideslips that a piece without a measured one may begin with [rad]
DECIDING = 2  # times `UNKNOWN_START` after which the likeliest is chosen
FIXED_GAIN = 0.3  # share of an innovation that a fixed gain believes


FURTHER = ("psi", "x", "y", "ax", "ay")  # columns that say what the sensors of V, beta and r err by


class MeasuredMotion(NamedTuple):
    """Further measurements of the motion along pieces, in the order of `FURTHER`."""

    y: np.ndarray  # (P, T, 5), zero where missing
    valid: np.ndarray  # (P, T, 5) 1 where measured, 0 where not


class Pieces(NamedTuple):
    """Runs cut into pieces of one length, padded with invalid samples."""

    padded: PaddedRun  # leading axis of pieces (P)
    run: np.ndarray  # (P,) number of the run
    block: np.ndarray  # (P, T) number of the block of each sample
    num_blocks: int
    dt: float
    motion: MeasuredMotion | None = None  # where runs have any of these channels
    skip: int = 0  # samples from the start of a piece in which the observer finds a state that is not measured
    force_known: bool = True  # where not, it was estimated from V, whose innovations then say nothing
    yaw_rate_measured: bool = True  # where not, the rate of the heading stands for it

    @property
    def size(self) -> int:
        """Return the number of samples T of one piece."""
        return self.block.shape[1]

    @property
    def force_inferred(self) -> bool:
        """Return whether neither sideslip nor drive force is measured: both follow from speed and yaw rate."""
        return bool(self.skip) and not self.force_known

    @property
    def informative(self) -> np.ndarray:
        """Return which innovations (T, 3) of a piece are informative about the car."""
        channels = np.array([self.force_known, True, True])
        return (np.arange(self.size) >= self.skip)[:, None] & channels

    def subset(self, keep: np.ndarray) -> "Pieces":
        """Return the pieces with the numbers `keep`."""
        names, block = np.unique(self.block[keep], return_inverse=True)
        padded, motion = take((self.padded, self.motion), keep)
        block = block.reshape(len(keep), -1)
        return self._replace(padded=padded, run=self.run[keep], block=block, num_blocks=len(names), motion=motion)


def error_blocks(data: Pieces) -> np.ndarray:
    """Return the number (P, T) of the block of length `ERROR_BLOCK` that each sample lies in."""
    span = np.asarray(data.padded.place.t) // ERROR_BLOCK
    return np.unique(data.run[:, None] * (1 + span.max()) + span, return_inverse=True)[1].reshape(span.shape)


def take(tree, which):
    """Return the entries `which` along the first axis of every array; in NumPy, which needs no compilation."""
    return jax.tree.map(lambda a: np.asarray(a)[which], tree)


def lap_lengths(runs: tuple[Run, ...]) -> list[float]:
    """Return the lap length of each run [m]: the range of `s` in a run where it restarts, else over all runs."""
    each = [fill_gaps(run.extra["s"]) if "s" in run.extra else np.zeros(1) for run in runs]
    total = max(s.max() for s in each) - min(s.min() for s in each)
    again = lambda s: len(s) > 1 and np.diff(s).min() < -0.5 * np.ptp(s) < 0
    return [float(np.ptp(s) if again(s) else total) or 1.0 for s in each]


def places(vehicle: VehicleConfig, run: Run, lap: float) -> Place:
    """Return time, heading, share of the lap of length `lap` [m] and sliding work along a run (n,)."""
    V, beta, r = fill_gaps(run.V), sideslip(vehicle, run), fill_gaps(run.r)
    heading = run.extra.get("psi", run.extra.get(TURNED))
    psi = integrated_yaw_rate(run) if heading is None else fill_gaps(heading)
    s = fill_gaps(run.extra["s"]) if "s" in run.extra else np.zeros_like(V)
    heat = np.asarray(eqx.filter_jit(heat_rate)(vehicle.build(), State(*map(jnp.asarray, (V, beta, r)))))
    columns = run.t - run.t[0], psi, s / lap, np.cumsum(heat) * run.dt
    return Place(*map(jnp.asarray, columns))


def piece_size(lengths: list[int]) -> int:
    """Return the number of samples of a piece for runs of these `lengths`: the short one where it saves computation."""
    padded_size = lambda size: sum(-(-n // size) * size for n in lengths)
    short, long = padded_size(SHORT_PIECE_LENGTH), padded_size(PIECE_LENGTH)
    return SHORT_PIECE_LENGTH if short <= WORTHWHILE * long else PIECE_LENGTH


def pieces(vehicle: VehicleConfig, runs: tuple[Run, ...]) -> Pieces:
    """Cut runs into pieces, without outliers; before its first command a run is assumed to keep that command."""
    runs = tuple(without_outliers(run, vehicle.a + vehicle.b) for run in runs)
    dt, rows, blocks, number, further = runs[0].dt, [], [], [], []
    size = piece_size([len(run.t) for run in runs])
    for i, (run, lap) in enumerate(zip(runs, lap_lengths(runs), strict=True)):
        n, place = len(run.t), places(vehicle, run, lap)
        for k in range(0, n, size):
            rows.append(_piece_of(run, sideslip(vehicle, run), place, k, size))
            further.append(_further_of(run, k, size))
            sample = np.minimum(k + np.arange(size), n - 1)  # padding belongs to the run's last block
            blocks.append([(i, int(j * dt // BLOCK)) for j in sample])
            number.append(i)
    names = {name: at for at, name in enumerate(sorted({one for row in blocks for one in row}))}
    block = np.array([[names[b] for b in row] for row in blocks])
    motion = np.stack(further)
    valid = np.isfinite(motion)
    known = MeasuredMotion(np.where(valid, motion, 0.0), valid.astype(float)) if valid.any() else None
    padded = jax.tree.map(lambda *a: jnp.asarray(np.stack(a)), *rows)
    unknown = not all(map(has_sideslip, runs))
    skip = round(UNKNOWN_START * np.sqrt((vehicle.a + vehicle.b) / G) / dt) if unknown else 0
    measured = not any(run.yaw_rate_of_heading for run in runs)
    return Pieces(padded, np.array(number), block, len(names), dt, known, skip, yaw_rate_measured=measured)


def _further_of(run: Run, k: int, size: int) -> np.ndarray:
    """Return the further measurements (size, 5) from sample `k`, NaN where there is none."""
    further = np.full((size, len(FURTHER)), np.nan)
    for i, name in enumerate(FURTHER):
        if name in run.extra:
            part = run.extra[name][k : k + size]
            further[: len(part), i] = part
    return further


def _piece_of(run: Run, beta: np.ndarray, place: Place, k: int, size: int) -> PaddedRun:
    """Return the piece of `run` of `size` samples that begins at sample `k`; `beta` (n,) has no gaps."""
    measured, w = np.stack([run.V, run.beta, run.r], axis=1), round(SETTLE / run.dt)
    lead = lambda values: np.concatenate([np.repeat(values[:1], w, axis=0), values])
    part = measured[k : k + size]
    short = size - len(part)
    pad = lambda values: np.concatenate([values, np.repeat(values[-1:], short, axis=0)])
    window, here = slice(k, k + w + len(part)), slice(k, k + len(part))
    valid = np.concatenate([np.isfinite(part), np.zeros((short, 3), bool)])
    start = [np.median(column[k : k + 3]) for column in (fill_gaps(run.V), beta, fill_gaps(run.r))]
    commands, V = lead(np.stack([run.delta, run.Fxr], axis=1))[window], lead(fill_gaps(run.V))[window]
    changes = np.concatenate([np.zeros((w, 2)), run.command_changes])[window]
    y = np.where(valid, pad(part), 0.0)
    there = Place(*(jnp.asarray(pad(np.asarray(column)[here])) for column in place))
    return PaddedRun(
        *jax.tree.map(
            jnp.asarray, (pad(commands), pad(changes), pad(V), there, y, valid.astype(float), np.array(start))
        )
    )


def _riccatis(A: Array, push: Array, valid: Array, noise: Array, dt: float, informative: Array) -> Gains:
    of = lambda A, push, valid: kalman_gains(A, push, valid, Noise.from_vector(noise), dt, informative)
    return jax.vmap(of)(A, push, valid)


def by_commands(model: Universal, theta: Array, runs: PaddedRun, dt: float) -> tuple[Array, Array]:
    return eqx.filter_vmap(command_derivatives, in_axes=(None, None, 0, None))(model, theta, runs, dt)


def map_pieces(function, num: int, *trees):
    """Apply `function` to all pieces of `trees` (leading axis) in batches of one size, with one program."""
    return concatenate_trees([function(*take(trees, row)) for row in batches(num, BATCH_SIZE)], num)


def batches(num: int, size: int) -> list[np.ndarray]:
    """Return the indices below `num` in batches of one `size`, the last one filled up with the last index."""
    return [np.minimum(np.arange(k, k + size), num - 1) for k in range(0, num, size)]


def padded_size(num: int, least: int) -> int:
    """Return the padded size for `num` rows: a power of two, at least `least`, so that one program serves many."""
    return max(least, 1 << (num - 1).bit_length())


def concatenate_trees(parts: list, num: int):
    """Concatenate trees along the first axis and return the first `num` entries."""
    return jax.tree.map(lambda *a: np.concatenate(a)[:num], *parts)


class Linearisation(NamedTuple):
    """Whitened innovations of the observer and derivatives of its predictions; zero where invalid."""

    e: Array  # (P, T, 3)
    J: Array  # (P, T, 3, K)
    path: Path  # what they come from
    steps: Steps
    lost: np.ndarray | None = None  # (P, T) samples from which on the observer has lost the car; None: nowhere


def fixed_gain(data: Pieces) -> Gains:
    """Return fixed gains, for use before any noise is known: `FIXED_GAIN` of each innovation is applied."""
    num = len(data.run)
    zeros = lambda *shape: np.zeros((num, *shape))
    L = zeros(data.size, 9, 3)
    L[..., :3, :] = FIXED_GAIN * np.eye(3)
    array = lambda *shape: jnp.asarray(zeros(*shape))
    still = Decay(array(), array())
    return Gains(jnp.asarray(L), array(data.size, 3, 3), still, array(data.size, 9, 9), array())


def extended_gains(model: Universal, data: Pieces, theta: np.ndarray, noise: np.ndarray) -> Gains:
    """Return the gains of the extended Kalman filter of the car `theta` (K,); `noise` as `Noise.as_vector`."""
    informative, parts = jnp.asarray(data.informative, float), []
    for batch in batches(len(data.run), LANES):
        runs = take(data.padded, batch)
        parts.append(call(filter_runs, model, jnp.asarray(theta), runs, jnp.asarray(noise), data.dt, informative)[0])
    return concatenate_trees(parts, len(data.run))


def with_likeliest_start(model: Universal, data: Pieces, theta: np.ndarray, noise: np.ndarray) -> Pieces:
    """Replace the sideslip at the start of each piece, which is not measured, by the likeliest of `STARTS` and itself.

    A rolling rear axle, which is assumed else, is far from that of a drift; from there the filter takes seconds.
    Pieces whose sideslip is measured are returned as they are.
    """
    if not data.skip:
        return data
    trials = np.repeat(np.array(data.padded.start)[:, None], 1 + len(STARTS), axis=1)
    trials[:, 1:, 1] = STARTS
    piece, flat = np.repeat(np.arange(len(trials)), trials.shape[1]), trials.reshape(-1, 3)
    soon = np.arange(data.size)[:, None] < DECIDING * data.skip
    every, costs = jnp.asarray(data._replace(skip=0).informative, float), []
    for row in batches(len(piece), LANES):
        runs = take(data.padded, piece[row])
        runs = runs._replace(start=flat[row], valid=soon * runs.valid)
        costs.append(call(filter_runs, model, jnp.asarray(theta), runs, jnp.asarray(noise), data.dt, every)[1])
    each = np.nan_to_num(concatenate_trees(costs, len(piece)), nan=np.inf).reshape(trials.shape[:2])
    start = np.take_along_axis(trials, each.argmin(axis=1)[:, None, None], axis=1)[:, 0]
    return data._replace(padded=data.padded._replace(start=jnp.asarray(start)))


def observer_gains(model: Universal, data: Pieces, theta: np.ndarray, noise: np.ndarray) -> Gains:
    """Return the gains along the path of the car `theta`, found from fixed ones; `noise` as `Noise.as_vector`.

    Where no sideslip is measured, they are those of the extended Kalman filter.
    """
    if data.skip:
        return extended_gains(model, data, theta, noise)
    gains = fixed_gain(data)
    for _ in range(2):
        path = run_observer(model, data, theta, gains)
        gains = gains_along(data, _each_sample(model, jnp.asarray(theta), path, data), path.valid, noise)
    return gains


def gains_along(data: Pieces, along: SampleDerivatives | Steps, valid: Array | np.ndarray, noise: np.ndarray) -> Gains:
    """Return the gains along pieces (P, T, ...) with these derivatives and measurements that are `valid` (P, T, 3)."""
    informative = jnp.asarray(data.informative, float)
    riccati_of = lambda A, push, valid: call(_riccatis, A, push, valid, jnp.asarray(noise), data.dt, informative)
    A, push = (np.asarray(by)[..., :3, :3] for by in (along.A, along.push))
    return map_pieces(riccati_of, len(data.run), A, push, valid)


def run_observer(model: Universal, data: Pieces, theta: np.ndarray | Array, gains: Gains) -> Path:
    """Run the observer along every piece, with one `theta` (K,) or one for each piece (P, K)."""
    return run_observers(model, data, theta_of_pieces(data, theta), np.arange(len(data.run)), gains)


def run_observers(model: Universal, data: Pieces, theta: np.ndarray, piece: np.ndarray, gains: Gains) -> Path:
    """Run the observer with the parameters `theta` (R, K) along the pieces with the numbers `piece` (R,).

    Pieces of like length are followed together: a batch takes as long as its longest.
    """
    length = samples_in_run(np.asarray(data.padded.valid)).sum(axis=1)
    order = np.argsort(-length[piece], kind="stable")
    parts = []
    for batch in batches(len(order), LANES):
        rows = take((data.padded, gains.L, gains.decay), piece[order[batch]])
        parts.append(call(observe_runs, model, jnp.asarray(theta[order[batch]]), *rows, data.dt))
    return take(concatenate_trees(parts, len(order)), np.argsort(order))


def theta_of_pieces(data: Pieces, theta: np.ndarray | Array) -> np.ndarray:
    """Return the parameters (P, K) of every piece: the same (K,) for all, or as they are."""
    theta = np.asarray(theta)
    return np.broadcast_to(theta, (len(data.run), theta.shape[-1]))


def _each_sample(model: Universal, theta: Array, path: Path, data: Pieces) -> SampleDerivatives:
    """Compute the derivatives of every step, leading axes (P, T), in batches of samples; zero in the padding."""
    lead = path.e.shape[:2]
    flat = jax.tree.map(lambda a: np.asarray(a).reshape(-1, *a.shape[2:]), (path, data.padded.place))
    within = np.flatnonzero(samples_in_run(np.asarray(data.padded.valid)))
    parts = []
    for batch in batches(len(within), SAMPLES):
        samples, there = take(flat, within[batch])
        parts.append(call(sample_derivatives, model, theta, samples, there, data.dt))

    def spread(a: np.ndarray) -> np.ndarray:
        full = np.zeros((lead[0] * lead[1], *a.shape[1:]))
        full[within] = a
        return full.reshape(*lead, *a.shape[1:])

    return jax.tree.map(spread, concatenate_trees(parts, len(within)))


def whiten(gains: Gains, e: Array) -> Array:
    """Return innovations (P, T, 3, ...) scaled to unit covariance."""
    return jnp.einsum("ptij,ptj...->pti...", gains.whitening, e)


def step_derivatives(model: Universal, data: Pieces, theta: np.ndarray, path: Path, active: np.ndarray) -> Steps:
    """Compute the derivatives of every step along `path`, those through the commands included.

    Those by parameters that are not `active` (K,) are zero: any part of the catalogue runs in the same programs.
    """
    where = jnp.asarray(theta)
    one = _each_sample(model, where, path, data)
    by_u, first = map_pieces(lambda run: call(by_commands, model, where, run, data.dt), len(data.run), data.padded)
    only = jnp.asarray(active, float)
    C, F = only * (one.by_theta + one.by_u @ by_u), only * one.F
    return Steps(one.A, C, one.D, F, one.slip, one.push, one.delay, path.valid, only * first)


def differentiate(
    model: Universal, data: Pieces, theta: np.ndarray, gains: Gains, active: np.ndarray, path: Path | None = None
) -> Linearisation:
    """Return whitened innovations and their derivatives by the `active` (K,) parameters, along the observer's `path`.

    That is run where it is omitted.
    """
    path = run_observer(model, data, theta, gains) if path is None else path
    steps = step_derivatives(model, data, theta, path, active)
    return Linearisation(whiten(gains, path.e), whitened_derivatives(steps, gains, data), path, steps)


def whitened_derivatives(steps: Steps, gains: Gains, data: Pieces, width: int | None = None) -> Array:
    """Return the derivatives (P, T, 3, K) of the whitened predictions, computed `width` columns at a time."""
    num = steps.C.shape[-1]
    width = width or num
    parts = []
    steps = jax.tree.map(np.asarray, steps)
    for k in range(0, num, width):
        pad = lambda a: np.pad(a[..., k : k + width], [(0, 0)] * (a.ndim - 1) + [(0, max(k + width - num, 0))])  # noqa: B023
        part = steps._replace(C=pad(steps.C), F=pad(steps.F), first=pad(steps.first))
        propagate = lambda steps, gains: call(propagate_pieces, steps, gains)
        parts.append(map_pieces(propagate, len(data.run), part, gains))
    return -whiten(gains, jnp.asarray(np.concatenate(parts, axis=-1)[..., :num]))
