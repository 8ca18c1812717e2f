"""All runs of a data set through the observer, in a few compiled programs of fixed shapes."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import State
from driftjax.diagnosis.observer import (
    Gains,
    Local,
    Path,
    Steps,
    Track,
    by_commands,
    chain,
    follow_run,
    local,
    riccati,
)
from driftjax.logs import Run
from driftjax.parallel import call
from driftjax.sim.rollout import SETTLE
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import Place
from driftjax.vehicle.effect.flow import heat_rate
from driftjax.vehicle.universal import Universal

PIECE, SHORT = 1000, 250  # samples of one piece: longer runs are followed piece by piece, many short ones in short ones
LANES = 2  # pieces followed at once: more take longer on a CPU where runs are few
SAMPLES = 2000  # samples differentiated in one call
BLOCK = 1.0  # length of the blocks in which innovations may depend on each other [s]
SPAN = 2.0  # and errors of predictions and smoothed forces [s]
HOLD = 0.3  # share of an innovation that a fixed gain believes


class Pieces(NamedTuple):
    """Runs in pieces of one length, padded with samples that were not measured."""

    track: Track  # leading axis of pieces (P)
    run: np.ndarray  # (P,) number of the run
    block: np.ndarray  # (P, T) number of the block of each sample
    num_blocks: int
    dt: float

    @property
    def size(self) -> int:
        """Samples T of one piece."""
        return self.block.shape[1]

    def part(self, keep: np.ndarray) -> "Pieces":
        """Only the pieces with the numbers `keep`."""
        names, block = np.unique(self.block[keep], return_inverse=True)
        return Pieces(pick(self.track, keep), self.run[keep], block.reshape(len(keep), -1), len(names), self.dt)


def spans(data: Pieces) -> np.ndarray:
    """Number (P, T) of the span that a sample lies in."""
    span = np.asarray(data.track.place.t) // SPAN
    return np.unique(data.run[:, None] * (1 + span.max()) + span, return_inverse=True)[1].reshape(span.shape)


def pick(tree, which):
    """Entries `which` along the first axis of every array; in NumPy, where cutting needs no program."""
    return jax.tree.map(lambda a: np.asarray(a)[which], tree)


def filled(values: np.ndarray) -> np.ndarray:
    """`values` (n,) with gaps filled linearly; zeros where nothing was measured at all."""
    good = np.isfinite(values)
    at = np.arange(len(values))
    return np.interp(at, at[good], values[good]) if good.any() else np.zeros_like(values)


def lap_length(runs: tuple[Run, ...]) -> list[float]:
    """Length of the lap that `s` counts in each run [m]: a run that begins `s` anew tells it, for others it is the
    range of all runs together."""
    each = [filled(run.extra["s"]) if "s" in run.extra else np.zeros(1) for run in runs]
    whole = max(s.max() for s in each) - min(s.min() for s in each)
    again = lambda s: len(s) > 1 and np.diff(s).min() < -0.5 * np.ptp(s) < 0
    return [float(np.ptp(s) if again(s) else whole) or 1.0 for s in each]


def places(vehicle: VehicleConfig, run: Run, lap: float) -> Place:
    """Time, heading, share of the lap of length `lap` [m] and sliding work along a run (n,)."""
    V, beta, r = filled(run.V), filled(run.beta), filled(run.r)
    psi = filled(run.extra["psi"]) if "psi" in run.extra else np.cumsum(r) * run.dt
    s = filled(run.extra["s"]) if "s" in run.extra else np.zeros_like(V)
    heat = np.asarray(heat_rate(vehicle.build(), State(*map(jnp.asarray, (V, beta, r)))))
    columns = run.t - run.t[0], psi, s / lap, np.cumsum(heat) * run.dt
    return Place(*map(jnp.asarray, columns))


def piece_size(lengths: list[int]) -> int:
    """Samples of one piece for runs of these `lengths`: short ones where they at least halve what is to be followed."""
    whole = lambda size: sum(-(-n // size) * size for n in lengths)
    return SHORT if 2 * whole(SHORT) <= whole(PIECE) else PIECE


def pieces(vehicle: VehicleConfig, runs: tuple[Run, ...]) -> Pieces:
    """Runs cut where they are longer than a piece; before its first command a run counts as driven with it held."""
    dt, rows, blocks, number = runs[0].dt, [], [], []
    size = piece_size([len(run.t) for run in runs])
    for i, (run, lap) in enumerate(zip(runs, lap_length(runs), strict=True)):
        n, place = len(run.t), places(vehicle, run, lap)
        for k in range(0, n, size):
            rows.append(_piece_of(run, place, k, size))
            sample = np.minimum(k + np.arange(size), n - 1)  # padding belongs to the run's last block
            blocks.append([(i, int(j * dt // BLOCK)) for j in sample])
            number.append(i)
    names = {name: at for at, name in enumerate(sorted({one for row in blocks for one in row}))}
    block = np.array([[names[b] for b in row] for row in blocks])
    return Pieces(jax.tree.map(lambda *a: jnp.stack(a), *rows), np.array(number), block, len(names), dt)


def _piece_of(run: Run, place: Place, k: int, size: int) -> Track:
    """The piece of `run` of `size` samples that begins at sample `k`."""
    measured, w = np.stack([run.V, run.beta, run.r], axis=1), round(SETTLE / run.dt)
    lead = lambda values: np.concatenate([np.repeat(values[:1], w, axis=0), values])
    part = measured[k : k + size]
    short = size - len(part)
    pad = lambda values: np.concatenate([values, np.repeat(values[-1:], short, axis=0)])
    window, here = slice(k, k + w + len(part)), slice(k, k + len(part))
    seen = np.concatenate([np.isfinite(part), np.zeros((short, 3), bool)])
    start = [np.median(filled(column)[k : k + 3]) for column in measured.T]
    commands, V = lead(np.stack([run.delta, run.Fxr], axis=1))[window], lead(filled(run.V))[window]
    y = np.where(seen, pad(part), 0.0)
    there = Place(*(jnp.asarray(pad(np.asarray(column)[here])) for column in place))
    return Track(*jax.tree.map(jnp.asarray, (pad(commands), pad(V), there, y, seen.astype(float), np.array(start))))


def _riccati(A: Array, seen: Array, noise: Array, dt: float) -> Gains:
    return riccati(A, seen, noise[:3], noise[3:6], jnp.exp(-dt / noise[6]), dt)


def _riccatis(A: Array, seen: Array, noise: Array, dt: float) -> Gains:
    return eqx.filter_vmap(_riccati, in_axes=(0, 0, None, None))(A, seen, noise, dt)


def _follow(model: Universal, theta: Array, runs: Track, gains: Gains, dt: float) -> Path:
    return eqx.filter_vmap(follow_run, in_axes=(None, None, 0, 0, None))(model, theta, runs, gains, dt)


def _chain(steps: Steps, gains: Gains, dt: float) -> Array:
    return eqx.filter_vmap(chain, in_axes=(0, 0, None))(steps, gains, dt)


def _by_commands(model: Universal, theta: Array, runs: Track, dt: float) -> tuple[Array, Array]:
    return eqx.filter_vmap(by_commands, in_axes=(None, None, 0, None))(model, theta, runs, dt)


def each_piece(function, num: int, *trees):
    """`function` of all pieces of `trees` (leading axis), `LANES` at once, so that one program serves any number."""
    rows = [np.minimum(np.arange(k, k + LANES), num - 1) for k in range(0, num, LANES)]
    return joined([function(*pick(trees, row)) for row in rows], num)


def joined(parts: list, num: int):
    """The first `num` entries of trees one after the other."""
    return jax.tree.map(lambda *a: np.concatenate(a)[:num], *parts)


class Followed(NamedTuple):
    """The observer's whitened innovations, and the derivatives of its predictions; zero where nothing was measured."""

    e: Array  # (P, T, 3)
    J: Array  # (P, T, 3, K)
    path: Path  # what they come from
    steps: Steps


def held(data: Pieces, share: float = HOLD) -> Gains:
    """A fixed gain that holds any car to the data, before any noise is known: it believes `share` of an innovation."""
    num = len(data.run)
    L = jnp.zeros((num, data.size, 6, 3)).at[..., :3, :].set(share * jnp.eye(3))
    nothing = jnp.zeros(num)
    return Gains(L, jnp.zeros((num, data.size, 3, 3)), nothing, jnp.zeros((num, data.size, 6, 6)), nothing)


def gains(model: Universal, data: Pieces, theta: np.ndarray, noise: np.ndarray, first: Gains) -> Gains:
    """Gains along the path of the car `theta`, that of `first` and then their own; `noise` (7,) as `Noise.row`."""
    found = first
    for _ in range(2):
        path = follow(model, data, theta, found)
        A = _each_sample(model, jnp.asarray(theta), path, data).A[..., :3, :3]
        riccati_of = lambda A, seen: call(_riccatis, A, seen, jnp.asarray(noise), data.dt)
        found = each_piece(riccati_of, len(data.run), A, path.seen)
    return found


def follow(model: Universal, data: Pieces, theta: np.ndarray | Array, gains: Gains) -> Path:
    """The observer along every piece."""
    one = lambda run, gains: call(_follow, model, jnp.asarray(theta), run, gains, data.dt)
    return each_piece(one, len(data.run), data.track, gains)


def _each_sample(model: Universal, theta: Array, path: Path, data: Pieces) -> Local:
    """Derivatives of every step, leading axes (P, T), some samples in each call."""
    lead = path.e.shape[:2]
    num = lead[0] * lead[1]
    flat = jax.tree.map(lambda a: a.reshape(num, *a.shape[2:]), (path, data.track.place))
    rows = [np.minimum(np.arange(k, k + SAMPLES), num - 1) for k in range(0, num, SAMPLES)]
    parts = []
    for which in rows:
        samples, there = pick(flat, which)
        parts.append(call(local, model, theta, samples, there, data.dt))
    return jax.tree.map(lambda a: a.reshape(*lead, *a.shape[1:]), joined(parts, num))


def whiten(gains: Gains, e: Array) -> Array:
    """Innovations (P, T, 3, ...) in units of what they should be."""
    return jnp.einsum("ptij,ptj...->pti...", gains.white, e)


def derivatives(model: Universal, data: Pieces, theta: np.ndarray, path: Path, asked: np.ndarray) -> Steps:
    """Derivatives of every step along `path`, those through the commands included; nothing but zeros for parameters
    that are not `asked` for (K,), so that any part of the catalogue runs in the same programs."""
    where = jnp.asarray(theta)
    one = _each_sample(model, where, path, data)
    by_u, first = each_piece(lambda run: call(_by_commands, model, where, run, data.dt), len(data.run), data.track)
    only = jnp.asarray(asked, float)
    C, F = only * (one.by_theta + one.by_u @ by_u), only * one.F
    return Steps(one.A, C, one.D, F, one.slip, one.push, one.late, path.seen, only * first)


def differentiate(model: Universal, data: Pieces, theta: np.ndarray, gains: Gains, asked: np.ndarray) -> Followed:
    """Whitened innovations and their derivatives by the parameters `asked` for (K,)."""
    path = follow(model, data, theta, gains)
    steps = derivatives(model, data, theta, path, asked)
    return Followed(whiten(gains, path.e), chained(steps, gains, data), path, steps)


def chained(steps: Steps, gains: Gains, data: Pieces) -> Array:
    """Derivatives (P, T, 3, K) of the whitened predictions."""
    one = lambda steps, gains: call(_chain, steps, gains, data.dt)
    return -whiten(gains, each_piece(one, len(data.run), steps, gains))
