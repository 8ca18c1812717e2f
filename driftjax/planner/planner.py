"""Compute the minimum-time plan: solve from several guesses, select the fastest converged solution."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from driftjax.core import RESULTS, Control, State, as_float
from driftjax.environment import require_float64
from driftjax.parallel import call
from driftjax.planner.config import PlanConfig, load_plan_config
from driftjax.planner.nodes import nodes
from driftjax.planner.problem import MinimumTime, PlanBounds, Stage
from driftjax.planner.stages import guesses, stages
from driftjax.solve import Options, Solution, solve_with_filter
from driftjax.track import Track, check_width, resample
from driftjax.vehicle import VehicleConfig, build_car

BARRIER = 0.03  # first barrier parameter: the guesses lie inside most bounds
VIOLATED = 1e-4  # violation from which an unconverged plan is called infeasible [-]
PATH_POINTS = 2  # grid points of the path per node


class Plan(eqx.Module):
    """Minimum-time plan on its nodes, and its quality measures (Wu et al. 2025, Eq. 8)."""

    s: Float[Array, " n"]  # along the track's centre line [m]
    t: Float[Array, " n"]  # time from the first node [s]
    V: Float[Array, " n"]  # [m/s]
    beta: Float[Array, " n"]  # [rad]
    r: Float[Array, " n"]  # [rad/s]
    e: Float[Array, " n"]  # offset from the centre line, left positive [m]
    theta: Float[Array, " n"]  # heading left of the centre line's tangent [rad]
    delta: Float[Array, " n"]  # [rad]
    Fxr: Float[Array, " n"]  # [N]
    x: Float[Array, " n"]  # [m]
    y: Float[Array, " n"]  # [m]
    psi: Float[Array, " n"]  # heading of the car in the world [rad]
    S: Float[Array, " n"]  # along the planned path itself [m]
    drift: Bool[Array, " n"]  # sideslip and yaw rate opposite in sign, and more than label_beta
    path: Track  # the planned path; its tangent is the course psi + beta, its widths reach to the track's borders
    lap_time: Array  # [s]
    closing: Array  # distance between the ends of a closed lap before they are joined [m]
    violation: Array  # worst defect or constraint violation, in scaled units of order one [-]
    kkt: Array  # scaled optimality error [-]
    num_steps: Array  # solver iterations of the guess that was kept
    result: RESULTS

    def drift_intervals(self) -> list[tuple[float, float]]:
        """Return `(start, end)` of every drift along the path's s [m], in order; for concrete plans, not under jit.

        Where only the yaw rate swings through zero while the car slides on, the drift goes on too.
        """
        drift, beta = np.concatenate([[False], np.asarray(self.drift), [False]]), np.asarray(self.beta)
        edges = np.flatnonzero(drift[1:] != drift[:-1])
        parts: list[tuple[int, int]] = []
        for start, end in zip(edges[::2], edges[1::2] - 1, strict=True):
            if parts and _slides_on(beta[parts[-1][1] : start + 1]):
                start, _ = parts.pop()
            parts.append((start, end))
        return [(float(self.S[a]), float(self.S[b])) for a, b in parts]

    def drift_interval(self) -> tuple[float, float]:
        """Return `(start, end)` of the longest drift along the path's s [m]; raises `ValueError` if there is none."""
        intervals = self.drift_intervals()
        if not intervals:
            raise ValueError("The plan has no drift; plan with the drift device, or lower label_beta.")
        return max(intervals, key=lambda ab: ab[1] - ab[0])


def _slides_on(beta: np.ndarray) -> bool:
    """Return whether sideslip (n,) keeps its sign and is nowhere less than at the smaller end."""
    size = np.sign(beta[0]) * beta
    return bool(np.all(size >= min(size[0], size[-1])) and size[-1] > 0)


def problem(vehicle: VehicleConfig, config: PlanConfig, stage: Stage, ds: float, model=None) -> MinimumTime:
    """Build the optimal control problem of `plan`, in its scaled units."""
    bounds = (config.V_min, config.V_max, vehicle.delta_max, vehicle.delta_rate_max, vehicle.Fxr_min,
              vehicle.Fxr_max, vehicle.Fxr_rate_max, config.end_slip)  # fmt: skip
    limits = PlanBounds(*map(as_float, bounds))
    kappa = np.abs(np.asarray(stage.kappa))
    L0 = min(1 / max(kappa.max(), 1e-3), 50 * vehicle.length)
    e0 = float(np.mean(np.asarray(stage.e_max - stage.e_min))) / 2
    nominal = build_car(vehicle)
    model = nominal if model is None else model
    fair = jnp.inf if config.V_fair is None else config.V_fair
    weights = (config.rate_weight, config.course_weight, config.front_slip, nominal, fair)
    return MinimumTime(model, limits, ds, config.entry_speed, L0, e0, *weights)


def solve_from(ocp: MinimumTime, x0: Array, stage: Stage, X: Array, options: Options) -> Solution:
    """Solve from the guess `X` (n, 7); its input rates follow from its inputs and speeds."""
    slowness = jax.vmap(ocp.slowness)(X, stage.kappa[:, 0])[:-1, None]
    full = jnp.stack([ocp.limits.delta_rate_max, ocp.limits.Fxr_rate_max])
    U = jnp.clip(jnp.diff(X[:, 5:] * ocp.scale[5:], axis=0) / (ocp.ds * slowness) / full, -0.8, 0.8)
    return solve_with_filter(ocp, x0, stage, X, U, options)


def _fastest(solutions: list[Solution]) -> Solution:
    """Select the cheapest converged solution; if none converged, the one with the least violation."""
    good = [one for one in solutions if one.result == RESULTS.successful]
    if good:
        return min(good, key=lambda one: float(one.cost))
    return min(solutions, key=lambda one: float(jnp.where(jnp.isfinite(one.violation), one.violation, jnp.inf)))


def _finish(ocp: MinimumTime, track: Track, stage: Stage, s: Array, best: Solution, label_beta: Array, cut) -> Plan:
    """Convert the solution to SI and world coordinates, cut to its lap, with the path that it drives."""
    states = best.X * ocp.scale
    time = jnp.concatenate([jnp.zeros(1), jnp.cumsum(_step_times(ocp, best.X, best.U, stage))])
    violated = (best.violation > VIOLATED) & (best.result != RESULTS.non_finite)
    result = RESULTS.where(violated, RESULTS.infeasible, best.result)
    lap = slice(cut[0], cut[1] + 1)
    (V, beta, r, e, theta, delta, Fxr), s, t = states[lap].T, s[lap], time[lap] - time[cut[0]]
    x, y = jax.vmap(track.position)(s, e)
    psi = jax.vmap(track.pose)(s)[2] + theta
    dx = jax.vmap(ocp.model)(State(V, beta, r), Control(delta, Fxr))
    kappa, S = (r + dx.beta) / V, _path_length(t, V, dx.V)
    w_right, w_left = jax.vmap(track.widths)(s)
    along = jnp.cos(theta + beta)  # borders are measured square to the course, not to the centre line
    count = PATH_POINTS * (len(s) - 1) + 1
    course, share = psi + beta, S / S[-1]
    ends = jnp.stack([x[-1] - x[0], y[-1] - y[0], course[-1] - course[0] - track.turn])
    closing = jnp.hypot(ends[0], ends[1]) if track.closed else jnp.zeros(())
    if track.closed:  # run-up and run-out leave a small gap: spread it over the lap
        px, py, course = (v - gap * share for v, gap in zip((x, y, course), ends, strict=True))
    else:
        px, py = x, y
    widths = ((w_right + e) / along, (w_left - e) / along)
    path = resample(S, px, py, course, kappa, *widths, count - track.closed, track.closed)
    drift = (beta * r < 0) & (jnp.abs(beta) > label_beta)
    return Plan(
        *(s, t, V, beta, r, e, theta, delta, Fxr, x, y, psi, S, drift),
        path=path,
        lap_time=t[-1],
        closing=closing,
        violation=best.violation,
        kkt=best.kkt,
        num_steps=best.num_steps,
        result=result,
    )


def _step_times(ocp: MinimumTime, X: Array, U: Array, stage: Stage) -> Array:
    """Return the duration of each step [s] by Simpson's rule, the middle state from half a Runge-Kutta step."""
    half = eqx.tree_at(lambda o: o.ds, ocp, ocp.ds / 2)
    stages = jax.tree.map(lambda p: p[:-1], stage)
    quarter = (stages.kappa[:, 0] + stages.kappa[:, 1]) / 2
    near = stages._replace(kappa=jnp.stack([stages.kappa[:, 0], quarter, stages.kappa[:, 1]], axis=1))
    middle = jax.vmap(half.step)(X[:-1], U, near)
    slow = jax.vmap(ocp.slowness)
    ends = slow(X[:-1], stages.kappa[:, 0]) + slow(X[1:], stages.kappa[:, 2])
    return ocp.ds / 6 * (ends + 4 * slow(middle, stages.kappa[:, 1]))


def _path_length(t: Array, V: Array, dV: Array) -> Array:
    """Return the distance driven at the nodes [m]: the integral of the cubic Hermite interpolant of the speed."""
    h = jnp.diff(t)
    steps = h * (V[:-1] + V[1:]) / 2 + h**2 * (dV[:-1] - dV[1:]) / 12
    return jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])


def plan(
    track: Track,
    vehicle: VehicleConfig,
    config: PlanConfig | None = None,
    model: Callable[[State, Control], State] | None = None,
) -> Plan:
    """Solve the minimum-time problem of a car along a track (Wu et al. 2025, Eq. 8).

    `config` defaults to that of the shipped car with the vehicle's name (`configs/plan`).

    Starts rolling straight on the centre line with the entry speed; a closed track is planned with a run-up and a
    run-out, which are cut off. Corners tighter than `drift_radius` are drifted where `config.drift`. `model` replaces
    the vehicle's own, for instance by a corrected one. `result` says whether the plan is valid; raises `BadInput` where
    the car does not fit the track.
    """
    require_float64()
    config = load_plan_config(vehicle.name) if config is None else config
    check_width(track, vehicle.width, "track")
    vehicle = config.planned(vehicle)
    at = nodes(track, vehicle.a + vehicle.b, config)
    stage, corners = stages(track, vehicle, config, at.s)
    ocp = problem(vehicle, config, stage, at.s[1] - at.s[0], model)
    scale = np.asarray(ocp.scale)
    x0 = jnp.asarray(np.array([config.entry_speed, *[0.0] * 6]) / scale)
    options = Options(tolerance=config.tolerance, barrier=BARRIER, max_steps=config.max_steps)
    first = [jnp.asarray(X / scale) for X in guesses(at.s, stage, corners, vehicle, config)]
    best = _fastest([call(solve_from, ocp, x0, stage, X, options) for X in first])
    label_beta = jnp.asarray(config.label_beta)
    return call(_finish, ocp, track, stage, jnp.asarray(at.s), best, label_beta, (at.first, at.last))
