"""LQR around a drift equilibrium, and along a whole reference: a controller that the paper compares with."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from driftjax.control.drift_batch_ocp import to_batch_ocp
from driftjax.control.mpc import DriftOCP, Reference
from driftjax.control.table import ReferenceTable
from driftjax.core import Control, State, rk4_step
from driftjax.solve.batch_conditions import filled
from driftjax.solve.component_derivatives import hessian

SWEEPS = 500  # Riccati iterations; drift equilibria converge in under 100


@eqx.filter_jit  # without it the loop would be compiled, and stored, in every call
def lqr(
    model: Callable[[State, Control], State],
    x: State,
    u: Control,
    Q: Float[Array, " 3"],
    R: Float[Array, " 2"],
    dt: Array,
) -> Float[Array, "2 3"]:
    """Compute the gain K, u = u_eq - K (x - x_eq), of the discrete LQR of `model` linearised at (x, u); all SI.

    The MPC penalises input changes; a static gain cannot, so `R` here penalises deviations from u_eq.
    """

    def step(x: Array, u: Array) -> Array:
        end = rk4_step(lambda w: model(w, Control(u[0], u[1])), State(x[0], x[1], x[2]), dt)
        return jnp.stack(end)

    A, B = jax.jacfwd(step, (0, 1))(jnp.stack(x), jnp.stack(u))
    scale = jnp.sqrt(R)  # inputs in units of their own cost keep the 2x2 solve well conditioned
    B = B / scale

    def sweep(_, P):
        S = B.T @ P @ A
        P = jnp.diag(Q) + A.T @ P @ A - S.T @ jnp.linalg.solve(jnp.eye(2) + B.T @ P @ B, S)
        return (P + P.T) / 2  # an antisymmetric rounding error would grow with the unstable modes of A

    P = jax.lax.fori_loop(0, SWEEPS, sweep, jnp.diag(Q))
    return jnp.linalg.solve(jnp.eye(2) + B.T @ P @ B, B.T @ P @ A) / scale[:, None]


class ScheduledLQR(eqx.Module):
    """Gains along a reference, on the state of the drift MPC: motion, place, last command and actuator outputs."""

    s: Float[Array, " N"]  # arc length of each gain [m]
    K: Float[Array, "N 2 9"]  # in the units of the MPC's solver

    def __call__(self, ocp: DriftOCP, s: Array, x: Float[Array, " 9"], x_ref: Float[Array, " 9"]) -> Float[Array, " 2"]:
        """Return the command (delta [rad], Fxr [N]) at arc length `s`, without limits; states in SI."""
        at = jnp.interp(s, self.s, jnp.arange(len(self.s), dtype=float))  # constant beyond the ends
        i = jnp.minimum(jnp.floor(at).astype(int), len(self.s) - 2)
        K = self.K[i] + (at - i) * (self.K[i + 1] - self.K[i])
        return x_ref[5:7] - (K @ ((x - x_ref) / state_units(ocp))) * ocp.u_scale


def state_units(ocp: DriftOCP) -> Float[Array, " 9"]:
    """Return the solver's units of the state: SI but for commands."""
    return jnp.concatenate([jnp.ones(5), ocp.u_scale, ocp.u_scale])


class LinearMPC(eqx.Module):
    """The drift MPC along a reference, to first order in the dynamics and second order in the cost; solver's units."""

    s: Float[Array, " N"]  # arc length of each step [m]
    A: Float[Array, "N 9 9"]
    B: Float[Array, "N 9 2"]
    H: Float[Array, "N 11 11"]  # half the second derivatives of the cost, state first
    u: Float[Array, "N 2"]  # inputs of the reference


def linearise_along(
    ocp: DriftOCP, table: ReferenceTable, num: int, lead: Array, rate_factor: Array | float = 1.0
) -> LinearMPC:
    """Linearise the drift MPC about the reference, `num` steps from `lead` [m] before the drift section.

    `rate_factor` multiplies the weight of input changes.
    """
    s = table.schedule(table.drift_start - lead, num, ocp.dt)[:-1]
    U = table.inputs(s)
    return LinearMPC(s, *_expansion(ocp, table.reference(s), U, rate_factor), U / ocp.u_scale)


def feedback_gains(model: LinearMPC) -> Float[Array, "N 2 9"]:
    """Compute the gains of the time-varying LQR, backwards from the stationary solution of the last step.

    (Anderson and Moore 1990, Sec. 2.4.) Without limits this is the feedback of the drift MPC.
    """

    def sweep(P, row):
        A, B, H = row
        S, R = H[9:, :9] + B.T @ P @ A, H[9:, 9:] + B.T @ P @ B
        K = jnp.linalg.solve(R, S)
        P = H[:9, :9] + A.T @ P @ A - S.T @ K
        return (P + P.T) / 2, K

    rows = model.A, model.B, model.H
    last = jax.tree.map(lambda a: a[-1], rows)
    P = jax.lax.fori_loop(0, SWEEPS, lambda _, P: sweep(P, last)[0], last[2][:9, :9])
    return jax.lax.scan(sweep, P, rows, reverse=True)[1]


def schedule_lqr(ocp: DriftOCP, table: ReferenceTable, num: int, lead: Array, rate_factor: Array) -> ScheduledLQR:
    """Compute the time-varying LQR along the reference, from `lead` [m] before the drift section, at `num` steps.

    Dynamics and cost are those of the drift MPC with `rate_factor` times the weight of input changes.
    """
    model = linearise_along(ocp, table, num, lead, rate_factor)
    return ScheduledLQR(model.s, feedback_gains(model))


def _expansion(
    ocp: DriftOCP, reference: Reference, U: Float[Array, "N 2"], rate_factor: Array | float
) -> tuple[Float[Array, "N 9 9"], Float[Array, "N 9 2"], Float[Array, "N 11 11"]]:
    """Return the dynamics to first and half of the cost to second order about a reference, in the solver's units."""
    one = jax.tree.map(lambda a: a[None], ocp)
    batch = to_batch_ocp(one, one.u_scale[:, 1])
    x = [column[:, None] for column in (*reference.states().T, *(U / ocp.u_scale).T)]
    u, p, nx = x[5:], jax.tree.map(lambda a: a[:, None], reference), len(x)
    M = batch.linearise(x, u, p, batch.local_expansion(x, u, p))[1]
    H = hessian(lambda *z: batch.cost(list(z[:nx]), list(z[nx:]), p), *x, *u, jacobian=batch.jacobian)[1]
    M, H = (jnp.moveaxis(jnp.asarray(filled(a, x[0])), (2, 3), (0, 1))[:, 0] for a in (M, H))
    place = jnp.array([0, 1, 2, 3, 4, 7, 8, 9, 10])  # of the problem's variables among state and input
    A = jnp.zeros((len(U), 9, 11)).at[:, place[:7, None], place].set(M).at[:, [5, 6], [9, 10]].set(1.0)
    H = jnp.zeros((len(U), 11, 11)).at[:, place[:, None], place].set(H / 2)
    change = jnp.eye(11)[9:] - jnp.eye(11)[5:7]
    R = rate_factor * ocp.R * ocp.u_scale**2
    return A[:, :, :9], A[:, :, 9:], H + (change.T * R) @ change
