"""Solve one problem in plain shapes: the adapter from `AbstractOCP` to the batched solver, as a batch of one."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, PyTree

from driftjax.solve.batch import plain, solve_batch
from driftjax.solve.batch_ocp import AbstractBatchOCP, Components
from driftjax.solve.component_derivatives import Matrix, jacobian_together
from driftjax.solve.ocp import AbstractOCP, Options, Solution


class _BatchOfOne(AbstractBatchOCP):
    """A problem in plain shapes by components; they and the parameters have the same first axes, (N, 1) or (1,)."""

    ocp: AbstractOCP

    def jacobian(self, function: Callable[..., Sequence[Array]], *z: Array) -> tuple[Components, Matrix]:
        """Return values and derivatives, of functions of any primitives."""
        return jacobian_together(function, *z)

    def step(self, x: Components, u: Components, p: PyTree) -> Components:
        """Return the next state."""
        return _split(_over_stages(self.ocp.step, (x, u), p))

    def cost(self, x: Components, u: Components, p: PyTree) -> Array:
        """Return the cost of one stage."""
        return _over_stages(self.ocp.cost, (x, u), p)

    def terminal(self, x: Components, p: PyTree) -> Array:
        """Return the cost of the last state."""
        return _over_stages(self.ocp.terminal, (x,), p)

    def constraints(self, x: Components, u: Components, p: PyTree) -> Components:
        """Return the constraint values of one stage."""
        return _split(_over_stages(self.ocp.constraints, (x, u), p))

    def terminal_constraints(self, x: Components, p: PyTree) -> Components:
        """Return the constraint values of the last state."""
        return _split(_over_stages(self.ocp.terminal_constraints, (x,), p))


def _over_stages(function: Callable[..., Array], vectors: Sequence[Components], p: PyTree) -> Array:
    """Map a function of one stage over the axes of the components; its vectors have the last axis."""
    for _ in range(vectors[0][0].ndim):
        function = jax.vmap(function)
    return function(*(jnp.stack(v, axis=-1) for v in vectors), p)


def _split(vectors: Array) -> Components:
    return list(jnp.moveaxis(vectors, -1, 0))


def solve(
    ocp: AbstractOCP,
    x0: Float[Array, " nx"],
    params: PyTree,
    X: Float[Array, "N+1 nx"],
    U: Float[Array, "N nu"],
    options: Options | None = None,
) -> Solution:
    """Solve one problem from the guess `X`, `U`; `params` has N+1 rows, the last for the end.

    Returns the last iterate with its residuals; see `solve_batch` for results and derivatives.
    """
    options = Options() if options is None else options
    by_component = lambda a: a.T[..., None]
    before, rows = jnp.zeros((U.shape[1], 1), U.dtype), jax.tree.map(lambda a: jnp.asarray(a)[:, None], params)
    start = (x0[:, None], before, rows, by_component(X), by_component(U))
    plans = plain(solve_batch(_BatchOfOne(ocp), *start, options))
    return jax.tree.map(lambda a: a[0], plans)
