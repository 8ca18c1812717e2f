"""Interface of an optimal control problem, and the solver's options and result."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

from driftjax.core import RESULTS, as_float


class AbstractOCP(eqx.Module):
    """A discrete-time optimal control problem with the first state fixed.

    minimise sum_k cost(x_k, u_k, p_k) + terminal(x_N, p_N)
    subject to x_{k+1} = step(x_k, u_k, p_k), constraints(x_k, u_k, p_k) >= 0, terminal_constraints(x_N, p_N) >= 0,

    for one problem and one stage; batches by `vmap` of `solve`. Constraints must be affine in (x, u). Scale the
    variables to order one. At most two inputs (their 2x2 block is made positive in closed form).
    """

    @abc.abstractmethod
    def step(self, x: Float[Array, " nx"], u: Float[Array, " nu"], p: PyTree) -> Float[Array, " nx"]:
        """Return the next state."""

    @abc.abstractmethod
    def cost(self, x: Float[Array, " nx"], u: Float[Array, " nu"], p: PyTree) -> Float[Array, ""]:
        """Return the cost of one stage."""

    @abc.abstractmethod
    def terminal(self, x: Float[Array, " nx"], p: PyTree) -> Float[Array, ""]:
        """Return the cost of the last state."""

    @abc.abstractmethod
    def constraints(self, x: Float[Array, " nx"], u: Float[Array, " nu"], p: PyTree) -> Float[Array, " ng"]:
        """Return the constraint values of one stage, feasible if not negative."""

    def terminal_constraints(self, x: Float[Array, " nx"], p: PyTree) -> Float[Array, " nt"]:
        """Return the constraint values of the last state; none by default."""
        return jnp.zeros((0,), x.dtype)


class Options(eqx.Module):
    """Solver options; all numbers are traced, so that a new value never causes a new compilation."""

    tolerance: Array = eqx.field(converter=as_float, default=1e-6)  # on the scaled KKT residual [-]
    barrier: Array = eqx.field(converter=as_float, default=1.0)  # first barrier parameter; small for warm starts
    max_steps: Array = eqx.field(converter=jnp.asarray, default=60)  # iterations
    implicit: Array = eqx.field(converter=as_float, default=1.0)  # tolerances up to which a solution has derivatives
    restarts: Array = eqx.field(converter=jnp.asarray, default=0)  # further attempts at what exceeds these


class Solution(eqx.Module):
    """Solution of one problem with its residuals."""

    X: Float[Array, "N+1 nx"]  # states
    U: Float[Array, "N nu"]  # inputs
    cost: Float[Array, ""]  # objective at (X, U)
    kkt: Float[Array, ""]  # scaled stationarity and complementarity [-]
    violation: Float[Array, ""]  # worst defect or constraint violation, 0 if feasible
    num_steps: Array  # iterations taken
    result: RESULTS


def shift(sequence: Float[Array, "*batch N n"]) -> Float[Array, "*batch N n"]:
    """Return the sequence shifted by one stage, last entry repeated: the warm start of the next solve."""
    return jnp.concatenate([sequence[..., 1:, :], sequence[..., -1:, :]], axis=-2)
