"""The drift MPC as one object: build it once, solve it for one state or a batch, differentiate through it."""

from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike

from driftjax.control.mpc import DriftOCP, MPCConfig, Reference, Weights, drift_ocp
from driftjax.control.mpc_solution import (
    MPCPlan,
    MPCProblem,
    MPCResponse,
    MPCSolution,
    judge_mpc,
    prepare_mpc,
    respond_mpc,
    solve_mpc_batch,
)
from driftjax.core import as_float, require
from driftjax.environment import require_float64
from driftjax.gp import zero_gp
from driftjax.solve import Options, shift
from driftjax.solve.batch_conditions import OptimalityError
from driftjax.solve.real_time import Preparation
from driftjax.vehicle import Residual, VehicleConfig, no_residual

BARRIER = 3.0  # first barrier parameter of a cold start
WARM_BARRIER = 1e-4  # of a warm start, which lies near the optimum


WarmStart: TypeAlias = MPCPlan | Array | np.ndarray | None


class MPCState(NamedTuple):
    """State of the car and its actuators; a leading axis is a batch."""

    x: Float[Array, "*batch 5"]  # V [m/s], beta [rad], r [rad/s], offset e [m], heading error theta [rad]
    command: Float[Array, "*batch 2"]  # last command: delta [rad], Fxr [N]
    lagged_input: Float[Array, "*batch 2"]  # actuator outputs, delta [rad] and Fxr [N]; `command` without lags


def mpc_state(x: ArrayLike, command: ArrayLike) -> MPCState:
    """Build the state of a car whose actuators have reached the last `command`.

    `x` (5,) or (batch, 5) is V [m/s], beta [rad], r [rad/s] and the offset e [m] and heading error theta [rad] from
    the path; `command` (2,) or (batch, 2) is delta [rad], Fxr [N].
    """
    x, command = jnp.asarray(x, float), jnp.asarray(command, float)
    require(x.shape[-1:] == (5,), f"x has shape {x.shape}; give V, beta, r, e, theta in the last axis.")
    require(command.shape[-1:] == (2,), f"command has shape {command.shape}; give delta, Fxr in the last axis.")
    return MPCState(x, jnp.broadcast_to(command, (*x.shape[:-1], 2)), jnp.broadcast_to(command, (*x.shape[:-1], 2)))


def steady_reference(V: float, beta: float, r: float, horizon: int) -> Reference:
    """Build the reference of a steady drift along a circle of its own radius, for `horizon` steps.

    Speed `V` [m/s], sideslip `beta` [rad] and yaw rate `r` [rad/s], left positive.
    """
    columns = (V, beta, r, 0.0, -beta, r / V)
    return Reference(*(jnp.full(horizon + 1, value, float) for value in columns))


class DriftMPC(eqx.Module):
    """Drift MPC of one car (Wu et al. 2025, Eq. 10): nominal car, named effects and learnt residual.

    >>> mpc = DriftMPC(load_vehicle("sedan"))
    >>> solution = mpc.solve(state, reference)
    >>> solution = mpc.solve(next_state, reference, solution)  # warm start

    At a fixed rate, in two halves (Diehl et al. 2005): `prepare` before the state is measured, `respond` after it.

    >>> prepared = mpc.prepare(expected_state, reference, solution)
    >>> solution = mpc.respond(prepared, measured_state)
    """

    ocp: DriftOCP
    options: Options

    def __init__(
        self,
        vehicle: VehicleConfig,
        config: MPCConfig | None = None,
        weights: Weights | None = None,
        residual: Residual | None = None,
    ):
        """`residual` is the learnt rate d(x, u) of (V, beta, r), none where left out; see `fit_gp` and `Residual`."""
        require_float64()
        config = MPCConfig() if config is None else config
        residual = no_residual(zero_gp(1, 5, 3)) if residual is None else residual
        self.ocp = drift_ocp(config, Weights() if weights is None else weights, vehicle, residual)
        self.options = Options(config.tolerance, BARRIER, config.max_steps)

    @property
    def horizon(self) -> int:
        """Return the number of prediction steps."""
        return self.ocp.horizon

    def solve(self, state: MPCState, reference: Reference, warm_start: WarmStart = None) -> MPCSolution:
        """Solve from `state` along `reference`.

        `warm_start` is the solution one step ago, which is shifted, or a guess of the inputs (horizon, 2), delta [rad]
        and Fxr [N], best those that go with the reference; left out, the last command held. The guess decides which
        optimum is found: beside a drift there is often one with saturated front and falling speed.

        A leading axis of `state.x` is a batch; `reference` is shared by it or has the same leading axis, and so has
        `warm_start`. `plan.result` of the solution says how each solve ended (`RESULTS`), `plan.kkt` and
        `plan.violation` how near to optimal it is; nothing raises on a failed solve, and its neighbours are not
        touched. Differentiable in everything by the implicit function theorem, forward and reverse, where the solve
        converged; derivatives are NaN elsewhere.
        """
        return self._solve(*self._problem(state, reference, warm_start))

    def prepare(self, expected: MPCState, reference: Reference, warm_start: WarmStart = None) -> Preparation:
        """Prepare a real-time iteration about the warm start, from the state `expected` when it will be applied.

        Arguments as for `solve`. This half needs no measurement: it linearises car and residual. The last `command` in
        `expected` is the one that acts until then.
        """
        return self._prepare(*self._problem(expected, reference, warm_start))

    @eqx.filter_jit
    def respond(self, prepared: Preparation, state: MPCState) -> MPCResponse:
        """Return the command for the measured `state`, from stored matrices alone.

        `response.error` is that of the quadratic program. Nothing raises; where `response.infeasible`, or the error
        stays above the tolerance, the plan before, one step later, is what to apply.
        """
        num = len(prepared.barrier)
        x, command, lagged_input = (jnp.broadcast_to(a, (num, a.shape[-1])) for a in state)
        answer = respond_mpc(jax.tree.map(lambda a: a[None], self.ocp), prepared, x, command, lagged_input)
        first = (lambda a: a[0]) if state.x.ndim == 1 else (lambda a: a)
        u, X, U = jax.tree.map(first, (answer.u, answer.X, answer.U))
        return MPCResponse(u, X, U, answer.response)

    @eqx.filter_jit
    def judge(self, prepared: Preparation, answer: MPCResponse) -> OptimalityError:
        """Return KKT residual and violation of the nonlinear problem at an answer (batch,): another linearisation."""
        return judge_mpc(jax.tree.map(lambda a: a[None], self.ocp), prepared, answer)

    def _problem(
        self, state: MPCState, reference: Reference, warm_start: WarmStart
    ) -> tuple[MPCState, Reference, Array, Array, Options]:
        """Return state, reference, guess and options, of the same types for all kinds of warm start."""
        warm_start = jnp.asarray(warm_start) if isinstance(warm_start, np.ndarray) else warm_start
        reference = jax.tree.map(as_float, reference)  # numbers without a fixed type would be another program
        barrier = WARM_BARRIER if isinstance(warm_start, MPCPlan) else BARRIER
        options = eqx.tree_at(lambda o: o.barrier, self.options, jnp.asarray(barrier))
        return state, reference, *self._guess(state, reference, warm_start), options

    @eqx.filter_jit
    def _guess(self, state: MPCState, reference: Reference, warm_start: MPCPlan | Array | None) -> tuple[Array, Array]:
        """Return states (*batch, N+1, 5) and inputs (*batch, N, 2) to start from; one solver serves all kinds."""
        batch, N = state.x.shape[:-1], self.horizon
        if isinstance(warm_start, MPCPlan):
            X, U = shift(warm_start.X), shift(warm_start.U)
        else:
            X, U = reference.states(), state.command[..., None, :] if warm_start is None else warm_start
        X = jnp.broadcast_to(X, (*batch, N + 1, X.shape[-1]))
        return X.at[..., 0, :].set(state.x), jnp.broadcast_to(U, (*batch, N, 2))

    @eqx.filter_jit
    def _solve(self, state: MPCState, reference: Reference, X: Array, U: Array, options: Options) -> MPCSolution:
        solution = solve_mpc_batch(*self._batch(state, reference, X, U, options))
        return jax.tree.map(lambda a: a[0], solution) if state.x.ndim == 1 else solution

    @eqx.filter_jit
    def _prepare(self, state: MPCState, reference: Reference, X: Array, U: Array, options: Options) -> Preparation:
        return prepare_mpc(*self._batch(state, reference, X, U, options))

    def _batch(
        self, state: MPCState, reference: Reference, X: Array, U: Array, options: Options
    ) -> tuple[DriftOCP, MPCProblem]:
        """Return the problem with a leading batch axis, of size 1 for a single state."""
        num = 1 if state.x.ndim == 1 else len(state.x)
        wide = lambda a, ndim: jnp.broadcast_to(a, (num, *a.shape[a.ndim - ndim :]))
        row = lambda a: wide(a, 1)
        x, command, lagged_input = map(row, state)
        rows = jax.tree.map(row, reference)
        problem = MPCProblem(x, command, lagged_input, rows, wide(X, 2), wide(U, 2), options)
        return jax.tree.map(lambda a: a[None], self.ocp), problem
