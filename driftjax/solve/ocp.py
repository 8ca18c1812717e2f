"""Interface of an optimal control problem, and the solver's options and result."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

from driftjax.core import RESULTS, as_float


class Linear(NamedTuple):
    """A step and its derivatives."""

    y: Float[Array, " nx"]  # next state
    A: Float[Array, "nx nx"]
    B: Float[Array, "nx nu"]


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

    def local_expansion(self, X: Float[Array, "N nx"], U: Float[Array, "N nu"], p: PyTree) -> PyTree:
        """Return the local expansion that `linearise` and `curvature` read, N rows for all stages; None by default."""

    def linearise(self, x: Float[Array, " nx"], u: Float[Array, " nu"], p: PyTree, expansion: PyTree) -> Linear:
        """Return the next state (nx,) and its derivatives (nx, nx), (nx, nu); override for a cheaper computation."""
        step = lambda x, u: (lambda y: (y, y))(self.step(x, u, p))
        (A, B), y = jax.jacfwd(step, (0, 1), has_aux=True)(x, u)
        return Linear(y, A, B)

    def curvature(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"], costate: Array, p: PyTree, expansion: PyTree
    ) -> Array:
        """Return the second derivative of `costate @ step` in (x, u), square of size nx + nu.

        A cheaper model of it changes the speed of convergence, never the solution; but derivatives of the solution
        are right with the exact one only.
        """
        bent = lambda w: costate @ self.step(w[: x.shape[0]], w[x.shape[0] :], p)
        return jax.hessian(bent)(jnp.concatenate([x, u]))


class Options(eqx.Module):
    """Solver options; all numbers are traced, so that a new value never causes a new compilation."""

    tolerance: Array = eqx.field(converter=as_float, default=1e-6)  # on the scaled KKT residual [-]
    barrier: Array = eqx.field(converter=as_float, default=1.0)  # first barrier parameter; small for warm starts
    max_steps: Array = eqx.field(converter=jnp.asarray, default=60)  # iterations: interior-point, or SQP of a batch
    implicit: Array = eqx.field(converter=as_float, default=1.0)  # tolerances up to which there are derivatives


class Solution(eqx.Module):
    """Solution of one problem with its residuals."""

    X: Float[Array, "N+1 nx"]  # states
    U: Float[Array, "N nu"]  # inputs
    cost: Float[Array, ""]  # objective at (X, U)
    kkt: Float[Array, ""]  # scaled stationarity and complementarity [-]
    violation: Float[Array, ""]  # worst defect or constraint violation, 0 if feasible
    num_steps: Array  # iterations taken
    result: RESULTS
