"""Interface of the batched solver: optimal control problems whose functions act on components."""

import abc
from collections.abc import Callable, Sequence
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Int, PyTree

from driftjax.solve.component_derivatives import Matrix, dot, hessian, jacobian

Components = list[Array]
BoxLimits = Sequence[tuple[Array | float | None, Array | float | None]]  # lower and upper, None for none


class AbstractBatchOCP(eqx.Module):
    """A discrete-time optimal control problem with the first state and the input before it fixed.

    minimise sum_k cost(x_k, u_k, p_k) + sum_k rate_weight (u_k - u_{k-1})^2 + terminal(x_N, p_N)
    subject to x_{k+1} = step(x_k, u_k, p_k), input, change and state limits,
    constraints(x_k, u_k, p_k) >= 0, terminal_constraints(x_N, p_N) >= 0.

    All functions take components (one array per entry of x and u, of any one shape) and act on each element by itself.
    Constraints are affine in (x, u). Scale the variables to order one. At most two inputs. Arrays in a problem have a
    leading batch axis, of size 1 where all entries share them.
    """

    def take(self, entries: Int[Array, " few"]) -> Self:
        """Return the problems of some batch entries."""
        some = lambda a: a[entries] if eqx.is_array(a) and jnp.ndim(a) and len(a) > 1 else a
        return jax.tree.map(some, self)

    @abc.abstractmethod
    def step(self, x: Components, u: Components, p: PyTree) -> Components:
        """Return the next state."""

    @abc.abstractmethod
    def cost(self, x: Components, u: Components, p: PyTree) -> Array:
        """Return the cost of one stage."""

    @abc.abstractmethod
    def terminal(self, x: Components, p: PyTree) -> Array:
        """Return the cost of the last state."""

    def rate_weight(self) -> Sequence[Array | float]:
        """Return the weight of the squared change of each input; none by default."""
        return ()

    def input_limits(self) -> BoxLimits:
        """Return the limits of each input; none by default."""
        return ()

    def change_limits(self) -> BoxLimits:
        """Return the limits of the change of each input between stages; none by default."""
        return ()

    def state_limits(self) -> BoxLimits:
        """Return the limits of each state of stages 1 to N; none by default."""
        return ()

    def constraints(self, x: Components, u: Components, p: PyTree) -> Components:
        """Return the constraint values of one stage, feasible if not negative; none by default."""
        return []

    def terminal_constraints(self, x: Components, p: PyTree) -> Components:
        """Return the constraint values of the last state; none by default."""
        return []

    def jacobian(self, function: Callable[..., Sequence[Array]], *z: Array) -> tuple[Components, Matrix]:
        """Return values and derivatives of a function of components: entry by entry, or override by the other way.

        `jacobian_together` compiles long functions in a fraction of the time, and is slower in large batches.
        """
        return jacobian(function, *z)

    def local_expansion(self, x: Components, u: Components, p: PyTree) -> PyTree:
        """Return the local expansion that `linearise` reads, None by default.

        It is for matrix products, which must not be mixed with elementwise work.
        """

    def linearise(
        self, x: Components, u: Components, p: PyTree, expansion: PyTree
    ) -> tuple[Components, Matrix, PyTree]:
        """Return the next state, its derivatives [state][state and input], and the data that `curvature` reads.

        Override for a cheaper computation.
        """
        return *self.jacobian(lambda *z: self.step(list(z[: len(x)]), list(z[len(x) :]), p), *x, *u), None

    def curvature(self, x: Components, u: Components, costate: Components, p: PyTree, more: PyTree) -> Matrix:
        """Return the second derivatives of `costate @ step` in (x, u)."""
        weighed = lambda *z: dot(costate, self.step(list(z[: len(x)]), list(z[len(x) :]), p))
        return hessian(weighed, *x, *u, jacobian=self.jacobian)[1]

    def early_curvature(
        self, x: Components, u: Components, costate: Components, p: PyTree, more: PyTree
    ) -> Matrix | None:
        """Return cheaper second derivatives for the first iterations; None for those of `curvature`.

        They change the speed of the solver, never the solution.
        """
