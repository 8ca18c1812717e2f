"""Optimal control problems whose functions act on components: what the batched solver needs to know."""

import abc
from collections.abc import Sequence
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Int, PyTree

from driftjax.solve.sparse import Matrix, dot, hessian, jacobian

Components = list[Array]
Limits = Sequence[tuple[Array | float | None, Array | float | None]]  # lower and upper, None for none


class AbstractLanes(eqx.Module):
    """A discrete-time optimal control problem with the first state and the input before it fixed.

    minimise sum_k cost(x_k, u_k, p_k) + sum_k rate_weight (u_k - u_{k-1})^2 + terminal(x_N, p_N)
    subject to x_{k+1} = step(x_k, u_k, p_k), input, change and state limits.

    All functions take components (one array per entry of x and u, of any one shape) and act on each element by itself.
    Scale the variables to order one. At most two inputs. Arrays in a problem have a leading axis of lanes, of 1 where
    all share them.
    """

    def of(self, lanes: Int[Array, " few"]) -> Self:
        """The problems of some lanes."""
        some = lambda a: a[lanes] if eqx.is_array(a) and jnp.ndim(a) and len(a) > 1 else a
        return jax.tree.map(some, self)

    @abc.abstractmethod
    def step(self, x: Components, u: Components, p: PyTree) -> Components:
        """Next state."""

    @abc.abstractmethod
    def cost(self, x: Components, u: Components, p: PyTree) -> Array:
        """Cost of one stage."""

    @abc.abstractmethod
    def terminal(self, x: Components, p: PyTree) -> Array:
        """Cost of the last state."""

    def rate_weight(self) -> Sequence[Array | float]:
        """Weight of the squared change of each input; none unless overridden."""
        return ()

    def input_limits(self) -> Limits:
        """Of each input; none unless overridden."""
        return ()

    def change_limits(self) -> Limits:
        """Of the change of each input from one stage to the next; none unless overridden."""
        return ()

    def state_limits(self) -> Limits:
        """Of each state of stages 1 to N; none unless overridden."""
        return ()

    def around(self, X: Components, U: Components, p: PyTree) -> PyTree:
        """What `linearise` and `expand` read at the iterate; None unless overridden."""

    def linearise(self, x: Components, u: Components, p: PyTree, around: PyTree) -> tuple[Components, Matrix]:
        """Next state and its derivatives [state][state and input]; to be overridden where there is a cheaper way."""
        return jacobian(lambda *z: self.step(list(z[: len(x)]), list(z[len(x) :]), p), *x, *u)

    def expand(
        self, x: Components, u: Components, costate: Components, p: PyTree, around: PyTree
    ) -> tuple[Components, Matrix, Matrix]:
        """As `linearise`, and second derivatives of `costate @ step` in (x, u).

        Cheaper second derivatives change the speed of the solver, never the solution.
        """

        def weighed(*z: Array) -> Array:
            return dot(costate, self.step(list(z[: len(x)]), list(z[len(x) :]), p))

        return *self.linearise(x, u, p, around), hessian(weighed, *x, *u)[1]
