"""An observer that follows every run: its innovations, and their derivatives by every parameter of the catalogue.

A Kalman filter of the car and of slowly varying disturbances of its rates predicts each sample from all samples and
commands before it. Its innovations are white if the model is right, whatever feedback made the commands, and they do
not grow with the drift's instability (Ljung 1999, Sec. 7.4 and 13.4; Kristensen, Madsen and Jorgensen 2004). Gains are
fixed by the noise and the nominal car; parameters then enter the prediction only.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from driftjax.core import Control, State
from driftjax.sim.rollout import Felt, acting, advance, begin, told
from driftjax.sim.sensitivity import move_with_derivatives
from driftjax.vehicle.effect import Place
from driftjax.vehicle.universal import Universal


class Track(NamedTuple):
    """One run, padded: T samples, with the w commands before them."""

    commands: Float[Array, "w+T 2"]
    V: Float[Array, " w+T"]
    place: Place  # fields (T,)
    y: Float[Array, "T 3"]  # measured V, beta, r; zero where missing
    seen: Float[Array, "T 3"]  # 1 where measured, 0 where not
    start: Float[Array, "3"]  # first state


class Gains(NamedTuple):
    """How the observer uses an innovation, and how large innovations are; per sample."""

    L: Float[Array, "T 6 3"]  # update of state and disturbances
    white: Float[Array, "T 3 3"]  # what makes innovations white and of unit variance, rows of missing channels zero
    left: Array  # share of a disturbance left after one step
    log_det: Array  # sum of the logarithms of the innovations' determinants


class Path(NamedTuple):
    """Where the observer went; per sample."""

    e: Float[Array, "T 3"]  # innovations, zero where missing
    z: Float[Array, "T 6"]  # state and what is felt after the update
    before: Float[Array, "T 6"]  # and before it
    rate: Float[Array, "T 3"]  # of the state, as the sensors feel it
    u: Float[Array, "T 2"]  # commands acting
    d: Float[Array, "T 3"]  # disturbances of the rates after the update


def driven(seen: Float[Array, "T 3"]) -> Array:
    """Whether a sample (T,) is one of the run: what follows its last measurement is padding, where nothing moves."""
    return jnp.flip(jax.lax.cummax(jnp.flip(jnp.max(seen, axis=1)))) > 0


def _felt_shift(model: Universal, x: Array, after: Array, u: Array) -> Array:
    """Change of what the tyres feel when the state is corrected from `x` to `after` (3,)."""
    slip = lambda v: jnp.stack(model.car.nominal.slip_angles(State(v[0], v[1], v[2]), Control(u[0], u[1])))
    return jnp.concatenate([after, slip(after) - slip(x), jnp.zeros(1)])


def follow_run(model: Universal, theta: Array, run: Track, gains: Gains, dt: float) -> Path:
    """The observer along one run."""
    model = eqx.tree_at(lambda m: m.theta, model, theta)
    T, step = len(run.y), jnp.asarray(dt)
    u_all = acting(model, run.commands, run.V, dt)
    u, before = u_all[-T:], u_all[-T - 1]
    z = begin(model, run.start, before, jax.tree.map(lambda a: a[0], run.place))

    def on(carry, row):
        z, d, last = carry
        u, place, y, seen, L, alive = row
        e = seen * (y - told(model, z[:3], (z[:3] - last) / step))
        update = L @ e
        x = z[:3] + update[:3]
        shifted = _felt_shift(model, z[:3], x, u)
        after = jnp.concatenate([x, z[3:] + shifted[3:]])
        d = d + update[3:]
        state, felt = State(x[0], x[1], x[2]), Felt(after[3:5], after[5])
        moved, felt = advance(model, state, felt, Control(u[0], u[1]), place, step, State(d[0], d[1], d[2]))
        ahead = jnp.concatenate([jnp.stack(moved), felt.slip, felt.ay[None]])
        next_one = jnp.where(alive, ahead, z), jnp.where(alive, gains.left * d, d), jnp.where(alive, x, last)
        return next_one, (e, jnp.where(alive, after, z), z, (z[:3] - last) / step, d)

    first = z, jnp.zeros(3), z[:3]
    e, z, predicted, rate, d = jax.lax.scan(on, first, (u, run.place, run.y, run.seen, gains.L, driven(run.seen)))[1]
    return Path(e, z, predicted, rate, u, d)


def riccati(A: Float[Array, "T 3 3"], seen: Array, sigma: Array, disturbance: Array, left: Array, dt: float) -> Gains:
    """Gains of one run from the state's transitions `A`, for white measurement noise and disturbances of the rates."""
    R, grown = jnp.diag(sigma**2), jnp.diag(disturbance**2)
    zero, eye = jnp.zeros((3, 3)), jnp.eye(3)
    start = jnp.block([[4 * R, zero], [zero, grown]])
    Q = jnp.block([[zero, zero], [zero, (1 - left**2) * grown]])

    def on(P, row):
        A, seen, alive = row
        H = jnp.concatenate([jnp.diag(seen), zero], axis=1)
        S = H @ P @ H.T + R * seen[:, None] * seen[None, :] + jnp.diag(1 - seen)
        factor = jnp.linalg.cholesky(S)
        white = jax.scipy.linalg.solve_triangular(factor, jnp.diag(seen), lower=True)
        L = jnp.linalg.solve(S, H @ P).T
        P = P - L @ S @ L.T
        F = jnp.block([[A, dt * (eye + A) / 2], [zero, left * eye]])
        P = jnp.where(alive, F @ P @ F.T + Q, P)
        return (P + P.T) / 2, (L, white, jnp.sum(jnp.log(jnp.diagonal(factor))))

    L, white, log_det = jax.lax.scan(on, start, (A, seen, driven(seen)))[1]
    return Gains(L, white, left, jnp.sum(log_det))


class Steps(NamedTuple):
    """Derivatives of every step of a run, each by itself."""

    A: Float[Array, "T 6 6"]  # next state and what is felt, by the same
    C: Float[Array, "T 6 K"]  # by theta, through the car and through the commands
    D: Float[Array, "T 3 3"]  # what is told, by the state
    F: Float[Array, "T 3 K"]  # by theta
    slip: Float[Array, "T 2 3"]  # slip angles by the state


def chain(steps: Steps, gains: Gains, seen: Array, dt: float) -> Float[Array, "T 3 K"]:
    """Derivatives of the innovations by theta: those of state and disturbances run along with the observer."""
    K = steps.C.shape[2]
    half = dt * (jnp.eye(3) + steps.A[:, :3, :3]) / 2

    def on(carry, row):
        S, d = carry
        one, L, seen, half, alive = row
        e = -seen[:, None] * (one.D @ S[:3] + one.F)
        S, d = _corrected(S, d, one.slip, L @ e)
        ahead = one.A @ S + one.C + jnp.concatenate([half @ d, jnp.zeros((3, K))])
        return (jnp.where(alive, ahead, S), gains.left * d), e

    start = jnp.zeros((6, K)), jnp.zeros((3, K))
    return jax.lax.scan(on, start, (steps, gains.L, seen, half, driven(seen)))[1]


def deviate(steps: Steps, e: Float[Array, "T 3"], L: Array, gains: Gains, seen: Array, dt: float) -> Array:
    """Innovations (T, 3) under `gains`, to first order, from those under the gains `L`."""
    half = dt * (jnp.eye(3) + steps.A[:, :3, :3]) / 2

    def on(carry, row):
        S, d = carry
        A, D, slip, e, old, L, seen, half, alive = row
        new = e - seen * (D @ S[:3])
        S, d = _corrected(S, d, slip, L @ new - old @ e)
        ahead = A @ S + jnp.concatenate([half @ d, jnp.zeros(3)])
        return (jnp.where(alive, ahead, S), gains.left * d), new

    rows = (steps.A, steps.D, steps.slip, e, L, gains.L, seen, half, driven(seen))
    return jax.lax.scan(on, (jnp.zeros(6), jnp.zeros(3)), rows)[1]


def _corrected(S: Array, d: Array, slip: Array, update: Array) -> tuple[Array, Array]:
    """State with what is felt (6, ...) and disturbances (3, ...) after an `update` (6, ...)."""
    nothing = jnp.zeros_like(update[:1])
    return S + jnp.concatenate([update[:3], slip @ update[:3], nothing]), d + update[3:]


def local(model: Universal, theta: Array, path: Path, place: Place, dt: float) -> tuple[Array, Steps]:
    """Derivatives at single samples (leading axis): by the command (6, 2), and the rest."""
    with_theta = lambda p: eqx.tree_at(lambda m: m.theta, model, p)
    car, step = with_theta(theta), jnp.asarray(dt)

    def one(path: Path, place: Place):
        by = move_with_derivatives(car, path.z, path.u, place, step).by
        D, F = jax.jacrev(lambda x, p: told(with_theta(p), x, path.rate), (0, 1))(path.before[:3], theta)
        slip = jax.jacrev(lambda v: _felt_shift(car, path.z[:3], v, path.u)[3:5])(path.z[:3])
        return by[:, 6:8], Steps(by[:, :6], by[:, 8:], D, F, slip)

    return jax.vmap(one)(path, place)


def by_commands(model: Universal, theta: Array, run: Track, dt: float) -> Float[Array, "T 2 K"]:
    """Derivatives of the commands acting; only effects of the actuators have any."""
    stations = [effect.station for effect in model.effects for _ in effect.parameters]
    columns = np.flatnonzero(np.array(stations) == "command")
    value = lambda p: acting(eqx.tree_at(lambda m: m.theta, model, p), run.commands, run.V, dt)[-len(run.y) :]
    each = jax.vmap(lambda d: jax.jvp(value, (theta,), (d,))[1])(jnp.eye(len(theta))[columns])
    return jnp.zeros((len(run.y), 2, len(theta))).at[:, :, columns].set(jnp.moveaxis(each, 0, -1))
