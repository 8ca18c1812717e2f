"""All runs of a data set through the observer, in a few compiled programs of fixed shapes."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.core import State
from driftjax.data import Run
from driftjax.diagnose.observer import Gains, Path, Steps, Track, by_commands, chain, follow_run, local, riccati
from driftjax.sim.rollout import SETTLE
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import Place
from driftjax.vehicle.effect.flow import heat_rate
from driftjax.vehicle.universal import Universal

PIECE = 1000  # samples of one piece of a run: longer runs are followed piece by piece
SAMPLES = 2000  # samples differentiated in one call
BLOCK = 2.0  # length of the blocks that count as independent [s]
HOLD = 0.3  # share of an innovation that a fixed gain believes


class Pieces(NamedTuple):
    """Runs in pieces of one length, padded with samples that were not measured."""

    track: Track  # leading axis of pieces (P)
    run: np.ndarray  # (P,) number of the run
    block: np.ndarray  # (P, T) number of the block of each sample
    num_blocks: int
    dt: float


def filled(values: np.ndarray) -> np.ndarray:
    """`values` (n,) with gaps filled linearly; zeros where nothing was measured at all."""
    good = np.isfinite(values)
    at = np.arange(len(values))
    return np.interp(at, at[good], values[good]) if good.any() else np.zeros_like(values)


def places(vehicle: VehicleConfig, run: Run) -> Place:
    """Time, heading, share of the lap and sliding work along a run (n,)."""
    nominal = vehicle.build()
    V, beta, r = filled(run.V), filled(run.beta), filled(run.r)
    psi = filled(run.extra["psi"]) if "psi" in run.extra else np.cumsum(r) * run.dt
    s = filled(run.extra["s"]) if "s" in run.extra else np.zeros_like(V)
    length = np.ptp(s) or 1.0
    heat = np.asarray(heat_rate(nominal, State(*map(jnp.asarray, (V, beta, r)))))
    columns = (run.t - run.t[0], psi, (s - s.min()) / length, np.cumsum(heat) * run.dt)
    return Place(*map(jnp.asarray, columns))


def pieces(vehicle: VehicleConfig, runs: tuple[Run, ...]) -> Pieces:
    """Runs cut where they are longer than a piece; before its first command a run counts as driven with it held."""
    dt, rows, blocks, number = runs[0].dt, [], [], []
    for i, run in enumerate(runs):
        for k in range(0, len(run.t), PIECE):
            rows.append(_piece_of(vehicle, run, k))
            blocks.append([(i, int((k + j) * dt // BLOCK)) for j in range(PIECE)])
            number.append(i)
    names = {name: at for at, name in enumerate(sorted({one for row in blocks for one in row}))}
    block = np.array([[names[b] for b in row] for row in blocks])
    return Pieces(jax.tree.map(lambda *a: np.stack(a), *rows), np.array(number), block, len(names), dt)


def _piece_of(vehicle: VehicleConfig, run: Run, k: int) -> Track:
    """The piece of `run` that begins at sample `k`."""
    measured, w = np.stack([run.V, run.beta, run.r], axis=1), round(SETTLE / run.dt)
    lead = lambda values: np.concatenate([np.repeat(values[:1], w, axis=0), values])
    part = measured[k : k + PIECE]
    short = PIECE - len(part)
    pad = lambda values: np.concatenate([values, np.repeat(values[-1:], short, axis=0)])
    window, here = slice(k, k + w + len(part)), slice(k, k + len(part))
    seen = np.concatenate([np.isfinite(part), np.zeros((short, 3), bool)])
    start = [np.median(filled(column)[k : k + 3]) for column in measured.T]
    commands, V = lead(np.stack([run.delta, run.Fxr], axis=1))[window], lead(filled(run.V))[window]
    place = Place(*(jnp.asarray(pad(column[here])) for column in places(vehicle, run)))
    y = np.where(seen, pad(part), 0.0)
    arrays = (pad(commands), pad(V), place, y, seen.astype(float), np.array(start))
    return Track(*jax.tree.map(jnp.asarray, arrays))


@eqx.filter_jit
def _follow(model: Universal, theta: Array, run: Track, gains: Gains, dt: float) -> Path:
    return follow_run(model, theta, run, gains, dt)


@eqx.filter_jit
def _local(model: Universal, theta: Array, path: Path, place: Place, dt: float) -> tuple[Array, Steps]:
    return local(model, theta, path, place, dt)


@eqx.filter_jit
def _chain(steps: Steps, gains: Gains, seen: Array, dt: float) -> Array:
    return chain(steps, gains, seen, dt)


@eqx.filter_jit
def _by_commands(model: Universal, theta: Array, run: Track, dt: float) -> Array:
    return by_commands(model, theta, run, dt)


@eqx.filter_jit
def _riccati(A: Array, seen: Array, noise: Array, dt: float) -> Gains:
    return riccati(A, seen, noise[:3], noise[3:6], jnp.exp(-dt / noise[6]), dt)


class Followed(NamedTuple):
    """The observer's whitened innovations, and the derivatives of its predictions; zero where nothing was measured."""

    e: Array  # (P, T, 3)
    J: Array  # (P, T, 3, K)


def held(data: Pieces, share: float = HOLD) -> Gains:
    """A fixed gain that holds any car to the data, before any noise is known: it believes `share` of an innovation."""
    num = len(data.run)
    L = jnp.zeros((num, PIECE, 6, 3)).at[..., :3, :].set(share * jnp.eye(3))
    return Gains(L, jnp.zeros((num, PIECE, 3, 3)), jnp.zeros(num), jnp.zeros(num))


def gains(model: Universal, data: Pieces, noise: np.ndarray, first: Gains) -> Gains:
    """Gains along the path of the nominal car, that of `first` and then their own; `noise` (7,) as `Noise.row`."""
    theta, found = jnp.zeros(len(model.theta)), first
    for _ in range(2):
        path = follow(model, data, theta, found)
        A = _each_sample(model, theta, path, data)[1].A[..., :3, :3]
        each = [_riccati(A[i], jnp.asarray(data.track.seen[i]), jnp.asarray(noise), data.dt) for i in range(len(A))]
        found = jax.tree.map(lambda *a: jnp.stack(a), *each)
    return found


def _piece(tree, i: int):
    return jax.tree.map(lambda a: jnp.asarray(a[i]), tree)


def follow(model: Universal, data: Pieces, theta: np.ndarray | Array, gains: Gains) -> Path:
    """The observer along every piece."""
    theta, num = jnp.asarray(theta), len(data.run)
    each = [_follow(model, theta, _piece(data.track, i), _piece(gains, i), data.dt) for i in range(num)]
    return jax.tree.map(lambda *a: jnp.stack(a), *each)


def _each_sample(model: Universal, theta: Array, path: Path, data: Pieces) -> tuple[Array, Steps]:
    """Derivatives of every step, leading axes (P, T), some samples in each call."""
    lead = path.e.shape[:2]
    num = lead[0] * lead[1]
    flat = jax.tree.map(lambda a: jnp.asarray(a).reshape(num, *a.shape[2:]), (path, data.track.place))
    rows = [np.minimum(np.arange(k, k + SAMPLES), num - 1) for k in range(0, num, SAMPLES)]
    pick = lambda which: jax.tree.map(lambda a: a[which], flat)
    parts = []
    for which in rows:
        samples, places = pick(which)
        parts.append(_local(model, theta, samples, places, data.dt))
    return jax.tree.map(lambda *a: jnp.concatenate(a)[:num].reshape(*lead, *a[0].shape[1:]), *parts)


def whiten(gains: Gains, e: Array) -> Array:
    """Innovations (P, T, 3, ...) in units of what they should be."""
    return jnp.einsum("ptij,ptj...->pti...", gains.white, e)


def derivatives(model: Universal, data: Pieces, theta: np.ndarray, path: Path) -> Steps:
    """Derivatives of every step along `path`, those through the commands included."""
    where = jnp.asarray(theta)
    B, steps = _each_sample(model, where, path, data)
    by_u = [_by_commands(model, where, _piece(data.track, i), data.dt) for i in range(len(data.run))]
    return steps._replace(C=steps.C + B @ jnp.stack(by_u))


def differentiate(model: Universal, data: Pieces, theta: np.ndarray, gains: Gains) -> Followed:
    """Whitened innovations and their derivatives by every parameter."""
    path = follow(model, data, theta, gains)
    steps = derivatives(model, data, theta, path)
    seen = jnp.asarray(data.track.seen)
    each = [_chain(_piece(steps, i), _piece(gains, i), seen[i], data.dt) for i in range(len(data.run))]
    return Followed(whiten(gains, path.e), -whiten(gains, jnp.stack(each)))
