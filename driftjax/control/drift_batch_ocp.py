"""Equations of the drift MPC by components, with the batch on the last axis."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import PyTree

from driftjax.control.mpc import DriftOCP, MPCConfig, Reference, Weights, drift_ocp
from driftjax.control.residual import ResidualDerivatives, residual_derivatives
from driftjax.core import Control, State, lag_step, rk4_step
from driftjax.gp import zero_gp
from driftjax.solve.batch_ocp import AbstractBatchOCP, BoxLimits, Components
from driftjax.solve.component_derivatives import (
    Entry,
    Matrix,
    column,
    dot,
    jacobian,
    jacobian_together,
    midpoint_curvature,
    runge_kutta,
    runge_kutta_curvature,
    times,
    total,
)
from driftjax.track import curvilinear_rates
from driftjax.vehicle import AnyCar, Residual, SingleTrack, VehicleConfig, beyond_peak, no_residual


class DriftBatchOCP(AbstractBatchOCP):
    """Eq. 10 (Wu et al. 2025): inputs delta [rad] and Fxr in `Fxr_unit` newtons, state (V, beta, r) in SI.

    Where the path is tracked (e, theta) follow, and with actuator lags the actuator outputs. Parameters of the solver
    are a `Reference` of components (N+1, batch). Leaves are (batch,), or (1,) where all entries share them; those of
    the residual have that axis in front. The residual is constant over the Runge-Kutta stages.
    """

    car: AnyCar
    dt: Array
    Q: Sequence[Array]  # weights on V, beta, r, and e, theta where the path is tracked
    R: Sequence[Array]  # weights on the changes of delta and of Fxr in its unit
    lower: Sequence[Array]  # smallest delta and Fxr
    upper: Sequence[Array]
    rate: Sequence[Array]  # largest change per step
    front_slip: Array | None  # weight on front slip beyond the tyre's peak; None for none
    residual: Residual | None
    lags: Sequence[Array] | None  # time constants of steering and drive [s]; None where commands act at once
    Fxr_unit: Array  # [N]

    @property
    def _model(self) -> AnyCar:
        """Return the car with the batch on the last axis of its parameters."""
        return jax.tree.map(jnp.transpose, self.car)

    def _rates(self, kappa: Array) -> Callable[..., list[Array]]:
        """Return the rates of the tracked state as a function of state, inputs, and the residual's rates if any."""
        n, car = len(self.Q), self._model

        def rates(*w: Array) -> list[Array]:
            dx = list(car(State(w[0], w[1], w[2]), Control(w[n], self.Fxr_unit * w[n + 1])))
            dx = [a + b for a, b in zip(dx, w[n + 2 :], strict=True)] if len(w) > n + 2 else dx
            return dx if n == 3 else [*dx, *curvilinear_rates(w[0], w[1], w[2], w[3], w[4], kappa)[1:]]

        return rates

    def _rate_inputs(self, acting: Components, expansion: ResidualDerivatives | None) -> Components:
        """Return the arguments of the rates that are constant over a step: mean inputs, the residual's rates if any."""
        return [*acting, *([] if expansion is None else expansion.d)]

    def _actuated(self, x: Components, u: Components) -> tuple[Components, Components]:
        """Return the mean input over a step, and the actuator outputs at its end."""
        if self.lags is None:
            return u, []
        moved = [lag_step(y, t, lag, self.dt) for y, t, lag in zip(x[len(self.Q) :], u, self.lags, strict=True)]
        return [acting for acting, _ in moved], [end for _, end in moved]

    def _shares(self) -> tuple[Components, Components]:
        """Return the weights of the initial actuator outputs in the mean input and in the final outputs."""
        one = jnp.ones_like(self.dt)
        kept = [lag_step(one, 0 * one, lag, self.dt) for lag in self.lags or ()]
        return [mean for mean, _ in kept], [left for _, left in kept]

    def _columns(self) -> list[tuple[int, Array | float]]:
        """Return for each entry of (x, u) the entry of (tracked, input) that it changes, and the factor."""
        n, (mean, _) = len(self.Q), self._shares()
        direct: list[tuple[int, Array | float]] = [(i, 1.0) for i in range(n)]
        if self.lags is None:
            return [*direct, (n, 1.0), (n + 1, 1.0)]
        return [*direct, *((n + i, share) for i, share in enumerate(mean)),
                *((n + i, 1 - share) for i, share in enumerate(mean))]  # fmt: skip

    def jacobian(self, function: Callable[..., Sequence[Array]], *z: Array) -> tuple[Components, Matrix]:
        """Return values and derivatives; for a car with named effects, whose function is long, all at once."""
        return (jacobian if isinstance(self.car, SingleTrack) else jacobian_together)(function, *z)

    def step(self, x: Components, u: Components, p: Reference) -> Components:
        """Return the next state by one RK4 step."""
        n, (acting, end) = len(self.Q), self._actuated(x, u)
        expansion, rates = self.local_expansion(x, u, p), self._rates(p.kappa)
        inputs = self._rate_inputs(acting, expansion)
        return [*rk4_step(lambda y: rates(*y, *inputs), list(x[:n]), self.dt), *end]

    def local_expansion(self, x: Components, u: Components, p: Reference) -> ResidualDerivatives | None:
        """Return the residual at all stages."""
        if self.residual is None:
            return None
        acting = self._actuated(x, u)[0]
        return residual_derivatives(self.residual, [*x[:3], *acting], (1.0, 1.0, 1.0, 1.0, self.Fxr_unit))

    def linearise(
        self, x: Components, u: Components, p: Reference, expansion: ResidualDerivatives | None
    ) -> tuple[Components, Matrix, PyTree]:
        """Return the next state and its derivatives, chained over the slopes of the RK4 step."""
        acting, end = self._actuated(x, u)
        inputs = self._rate_inputs(acting, expansion)
        y, M = runge_kutta(self._rates(p.kappa), x[: len(self.Q)], inputs, self.dt, self.jacobian)
        return [*y, *end], self._by_state_and_input(M, x, expansion), (y, M, expansion)

    def _by_state_and_input(self, M: Matrix, x: Components, expansion: ResidualDerivatives | None) -> Matrix:
        """Return derivatives of the next state by (x, u) from those by (tracked, acting, residual's rates)."""
        n, m = len(self.Q), len(self.R)
        if expansion is not None:
            J = self._wide(expansion.J)
            M = [[total((row[j], dot(row[n + m :], column(J, j)))) for j in range(n + m)] for row in M]
        M = [[times(share, row[j]) for j, share in self._columns()] for row in M]
        for i, share in enumerate(self._shares()[1]):
            row: list[Entry] = [None] * (len(x) + m)
            row[n + i], row[len(x) + i] = share + jnp.zeros_like(x[0]), 1 - share + jnp.zeros_like(x[0])
            M.append(row)
        return M

    def _wide(self, J: Matrix) -> Matrix:
        """Pad derivatives by (V, beta, r, acting) to derivatives by (tracked, acting)."""
        return [[*row[:3], *[None] * (len(self.Q) - 3), *row[3:]] for row in J]

    def curvature(self, x: Components, u: Components, costate: Components, p: Reference, more: PyTree) -> Matrix:
        """Return second derivatives of the step (see `runge_kutta_curvature`)."""
        inputs = self._rate_inputs(self._actuated(x, u)[0], more[2])
        H = runge_kutta_curvature(
            self._rates(p.kappa), x[: len(self.Q)], inputs, self.dt, costate[: len(self.Q)], self.jacobian
        )
        return self._curvature_by_state_and_input(H, costate, more)

    def early_curvature(self, x: Components, u: Components, costate: Components, p: Reference, more: PyTree) -> Matrix:
        """Return second derivatives of the step, to the second order in dt (see `midpoint_curvature`)."""
        inputs, n = self._rate_inputs(self._actuated(x, u)[0], more[2]), len(self.Q)
        H = midpoint_curvature(self._rates(p.kappa), x[:n], inputs, more[:2], self.dt, costate[:n], self.jacobian)
        return self._curvature_by_state_and_input(H, costate, more)

    def _curvature_by_state_and_input(self, H: Matrix, costate: Components, more: PyTree) -> Matrix:
        """Return second derivatives by (x, u) from those by (tracked, acting, residual's rates)."""
        (_, M, expansion), n = more, len(self.Q)
        if expansion is not None:
            weight = [dot(costate[:n], column(M, n + len(self.R) + k)) for k in range(3)]
            H = self._with_residual(H, expansion, weight)
        columns = self._columns()
        return [[times(a, b, H[i][j]) for j, b in columns] for i, a in columns]

    def _with_residual(self, H: Matrix, expansion: ResidualDerivatives, weight: Components) -> Matrix:
        """Return second derivatives by (tracked, acting), with the chain rule through the residual's rates."""
        m = len(self.Q) + 2
        J = self._wide(expansion.J)
        bend = [self._wide([*self._wide_rows(h)]) for h in expansion.H]
        W = [[total((H[i][j], dot(H[i][m:], column(J, j)))) for j in range(m)] for i in range(m + 3)]
        return [
            [total((W[i][j], dot(column(J, i), [W[m + k][j] for k in range(3)]),
                    *(times(w, h[i][j]) for w, h in zip(weight, bend, strict=True)))) for j in range(m)]
            for i in range(m)
        ]  # fmt: skip

    def _wide_rows(self, H: Matrix) -> Matrix:
        return [*H[:3], *[[None] * 5 for _ in range(len(self.Q) - 3)], *H[3:]]

    def cost(self, x: Components, u: Components, p: Reference) -> Array:
        """Return the tracking cost of this state, and of front slip beyond the peak."""
        tracking = self.terminal(x, p)
        if self.front_slip is None:
            return tracking
        delta, Fxr = self._actuated(x, u)[0]
        return (
            tracking
            + self.front_slip * beyond_peak(self._model, State(*x[:3]), Control(delta, self.Fxr_unit * Fxr)) ** 2
        )

    def terminal(self, x: Components, p: Reference) -> Array:
        """Return the tracking cost of this state."""
        aims = (p.V, p.beta, p.r, p.e, p.theta)
        return jnp.asarray(sum(q * (a - b) ** 2 for q, a, b in zip(self.Q, x, aims, strict=False)))

    def rate_weight(self) -> Sequence[Array]:
        """Return the weights on input changes."""
        return self.R

    def input_limits(self) -> BoxLimits:
        """Return the limits of delta and Fxr."""
        return list(zip(self.lower, self.upper, strict=True))

    def change_limits(self) -> BoxLimits:
        """Return the limits of input changes per step."""
        return [(-rate, rate) for rate in self.rate]


def to_batch_ocp(
    ocp: DriftOCP,
    Fxr_unit: Array,
    *,
    path: bool = True,
    front_slip: bool = True,
    residual: bool = True,
    lags: bool = True,
) -> DriftBatchOCP:
    """Convert problems `ocp`, with a leading batch axis as `Fxr_unit` has, keeping only the requested terms."""
    unit = jnp.stack([jnp.ones_like(Fxr_unit), Fxr_unit], axis=-1)
    split = lambda a: list(a.T)
    return DriftBatchOCP(
        car=ocp.car,
        dt=ocp.dt,
        Q=split(ocp.Q)[: 5 if path else 3],
        R=split(ocp.R * unit**2),
        lower=split(ocp.lower / unit),
        upper=split(ocp.upper / unit),
        rate=split(ocp.rate / unit),
        front_slip=ocp.front_slip if front_slip else None,
        residual=ocp.residual if residual else None,
        lags=split(ocp.residual.lags) if lags else None,
        Fxr_unit=Fxr_unit,
    )


def drift_batch_ocp(
    config: MPCConfig, weights: Weights, vehicle: VehicleConfig, residual: Residual | None = None, dtype: type = float
) -> DriftBatchOCP:
    """Build the problem shared by all entries, in one precision, without terms that weights and lags disable."""
    ocp = drift_ocp(config, weights, vehicle, no_residual(zero_gp(1, 5, 3)) if residual is None else residual)
    wide = jax.tree.map(lambda a: a[None].astype(dtype) if eqx.is_inexact_array(a) else a[None], ocp)
    return to_batch_ocp(
        wide,
        jnp.full(1, config.Fxr_unit, dtype),
        path=max(weights.Q_path) > 0,
        front_slip=weights.front_slip > 0,
        residual=residual is not None,
        lags=bool(np.any(np.asarray(ocp.residual.lags) > 0)),
    )
