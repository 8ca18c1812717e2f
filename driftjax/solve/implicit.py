"""The solver as a differentiable function: derivatives by the implicit function theorem, not through the iterations.

At the solution w = (X, U, multipliers, slacks) of the last barrier problem the optimality conditions F(w, theta) = 0
hold, so that dw = -(dF/dw)^-1 (dF/dtheta) dtheta. The matrix is the one of the Newton step; it is factorised once, by
a Riccati sweep, and the linear part of the sweep is done for each direction. Active limits are part of F: where a
slack is much smaller than its multiplier the limit holds in the derivative as well.
Sources: Amos et al. 2018 (differentiable MPC); Pirnay et al. 2012 (sensitivities of an interior point).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PyTree

from driftjax.solve.interior_point import Iterate, OCPInstance, problem_of, quadratic, solve_interior_point
from driftjax.solve.ocp import AbstractOCP, Options, Solution
from driftjax.solve.riccati import Quadratic
from driftjax.solve.riccati_factors import RiccatiFactors


def solve(ocp: AbstractOCP, x0: Array, params: PyTree, X: Array, U: Array, options: Options | None = None) -> Solution:
    """Solve one problem from the guess `X` (N+1, nx), `U` (N, nu); `params` has N+1 rows, the last for the end.

    Returns the last iterate with its residuals. `result` is `successful` only where KKT residual and violation are
    below the tolerance; `stalled` where no direction gave descent; `not_converged` after the last iteration allowed.

    `X`, `U` and `cost` are differentiable in `ocp`, `x0` and `params`, in both modes, as exactly as the tolerance;
    guess, options and residuals carry no derivative. Where the residuals exceed `options.implicit` tolerances, or the
    point is no strict minimum, all derivatives are NaN.
    """
    return _solve(ocp, x0, params, X, U, Options() if options is None else options)


@eqx.filter_custom_jvp
def _solve(ocp: AbstractOCP, x0: Array, params: PyTree, X: Array, U: Array, options: Options) -> Solution:
    return solve_interior_point(ocp, x0, params, X, U, options)[0]


class ConditionsTangent(NamedTuple):
    """Directional derivative of the optimality conditions in the data of the problem, at a fixed point."""

    hx: Float[Array, "N nx"]  # gradient of the Lagrangian
    hu: Float[Array, "N nu"]
    hN: Float[Array, " nx"]
    c: Float[Array, "N nx"]  # defects
    dx0: Float[Array, " nx"]  # first state


@_solve.def_jvp
def _tangent(primals, tangents):
    ocp, x0, params, *_, options = primals
    plan, it = solve_interior_point(*primals)
    d_ocp, d_x0, d_params, *_ = tangents
    problem = problem_of(ocp, params, it.X, it.U)
    m = problem.linearise(it.X, it.U)
    zero = jnp.zeros((), int)
    q = quadratic(problem, m, it, jnp.zeros(()), zero)
    factors = factorise_exactly(q)
    tangent = _conditions_tangent(problem, it, (ocp, params), (d_ocp, d_params))
    tangent = tangent._replace(dx0=jnp.zeros_like(x0) if d_x0 is None else d_x0)
    dX, dU = state_input_tangent(q, factors, tangent)
    objective = lambda ocp, params, X, U: problem_of(ocp, params, it.X, it.U).objective(X, U)
    d_cost = _along(objective, (ocp, params, it.X, it.U), (d_ocp, d_params, dX, dU))
    known = jnp.maximum(plan.kkt, plan.violation) <= options.implicit * options.tolerance  # False on NaN
    mark = jnp.where(known & factors.convex, 1.0, jnp.nan)
    none = jax.tree.map(lambda _: None, plan.result)
    return plan, Solution(mark * dX, mark * dU, mark * d_cost, None, None, None, none)  # pyright: ignore


def _conditions_tangent(problem: OCPInstance, it: Iterate, theta: tuple, d_theta: tuple) -> ConditionsTangent:
    """Return the derivative of the conditions along `d_theta`; multipliers and slacks are eliminated."""

    def conditions(ocp, params):
        here = problem_of(ocp, params, it.X, it.U)

        def lagrangian(X, U):
            dynamics = jnp.sum(it.costates * here.defects(X, U))
            gaps = zip(it.dual, here.gaps(X, U), strict=True)
            return here.objective(X, U) + dynamics - sum(jnp.sum(z * g) for z, g in gaps)

        return jax.grad(lagrangian, (0, 1))(it.X, it.U), here.defects(it.X, it.U), here.gaps(it.X, it.U)

    (gX, gU), c, gap = _along(conditions, theta, d_theta)
    pull = jax.tree.map(lambda z, s, g: z / s * g, it.dual, it.slack, gap)
    return ConditionsTangent(
        hx=gX[:-1] + jnp.einsum("kgi,kg->ki", problem.Gx, pull[0]),
        hu=gU + jnp.einsum("kgi,kg->ki", problem.Gu, pull[0]),
        hN=gX[-1] + problem.GN.T @ pull[1],
        c=c,
        dx0=jnp.zeros_like(it.X[0]),
    )


def _along(function: Callable[..., PyTree], theta: tuple, d_theta: tuple) -> PyTree:
    """Return the directional derivative; `d_theta` is None for a constant `theta`."""
    out, d_out = eqx.filter_jvp(function, theta, d_theta)
    return jax.tree.map(lambda y, d: jnp.zeros_like(y) if d is None else d, out, d_out)


def factorise_exactly(q: Quadratic) -> RiccatiFactors:
    """Return the Riccati factors of `q` at a solution, independent of its linear part; no eigenvalue is raised."""

    def backward(P, stage):
        Hxx, Hux, Huu, A, B = stage
        PA, PB = P @ A, P @ B
        S, R = Hux + B.T @ PA, Huu + B.T @ PB
        inverse, positive = _inverse(R)
        K = -inverse @ S
        before = Hxx + A.T @ PA + S.T @ K
        return 0.5 * (before + before.T), (K, inverse, P, positive)

    _, (K, inverse, P, positive) = jax.lax.scan(backward, q.HN, (q.Hxx, q.Hux, q.Huu, q.A, q.B), reverse=True)
    return RiccatiFactors(K, inverse, P, jnp.all(positive))


def _inverse(R: Float[Array, "nu nu"]) -> tuple[Float[Array, "nu nu"], Bool[Array, ""]]:
    """Return the inverse of a 1x1 or 2x2 symmetric matrix, and whether it is positive definite.

    No eigenvalue is raised: weights of active limits cancel in the sweep, and a raised one would not.
    """
    if R.shape[0] == 1:
        return 1 / R, R[0, 0] > 0
    schur = R[1, 1] - R[0, 1] ** 2 / R[0, 0]
    ratio = R[0, 1] / R[0, 0]
    inverse = jnp.array([[1 / R[0, 0] + ratio**2 / schur, -ratio / schur], [-ratio / schur, 1 / schur]])
    return inverse, (R[0, 0] > 0) & (schur > 0)


def state_input_tangent(
    q: Quadratic, factors: RiccatiFactors, tangent: ConditionsTangent
) -> tuple[Float[Array, "N+1 nx"], Float[Array, "N nu"]]:
    """Return the derivatives of states and inputs that keep the optimality conditions; linear in `tangent`."""
    K, inverse, P, _ = factors

    def backward(p, stage):
        A, B, K, inverse, P, hx, hu, c = stage
        g = P @ c + p
        k = -inverse @ (hu + B.T @ g)
        return hx + A.T @ g + K.T @ (hu + B.T @ g), k

    stages = (q.A, q.B, K, inverse, P, tangent.hx, tangent.hu, tangent.c)
    _, k = jax.lax.scan(backward, tangent.hN, stages, reverse=True)

    def forward(dx, stage):
        A, B, K, k, c = stage
        du = K @ dx + k
        after = A @ dx + B @ du + c
        return after, (after, du)

    _, (dX, dU) = jax.lax.scan(forward, tangent.dx0, (q.A, q.B, K, k, tangent.c))
    return jnp.concatenate([tangent.dx0[None], dX]), dU
