"""Independent transcription of the planner in CasADi for IPOPT: other derivatives and another solver."""

from typing import NamedTuple

import casadi as ca
import numpy as np

from driftjax.planner import PlanConfig
from driftjax.planner.problem import Stage
from driftjax.studies.bench.casadi_car import generated, single_track
from driftjax.vehicle import VehicleConfig

UNIT = 0.1  # seconds that the objective is written in, so that IPOPT's own scaling suits it


class PlanSolution(NamedTuple):
    """Result of one solve."""

    states: np.ndarray  # (n, 7) V, beta, r, e, theta, delta, Fxr
    cost: float  # objective [s]
    success: bool


class CasadiPlan:
    """The plan on `n` nodes `ds` [m] apart for IPOPT: `compiled` to C by gcc, or evaluated by CasADi.

    Variables are the states over `scale` (7,), and the rates of the inputs as a share of their largest.
    """

    def __init__(
        self,
        vehicle: VehicleConfig,
        config: PlanConfig,
        stage: Stage,
        ds: float,
        scale: np.ndarray,
        compiled: bool = False,
        tolerance: float = 1e-8,
    ):
        n = len(np.asarray(stage.share))
        self.scale, self.nodes = scale, n
        X, U = ca.MX.sym("X", 7, n), ca.MX.sym("U", 2, n - 1)
        step, slowness = _step(vehicle, ds, scale)
        k = np.asarray(stage.kappa).T
        defects = step.map(n - 1)(X[:, :-1], U, k[:, :-1]) - X[:, 1:]
        slip = -np.asarray(stage.side)[None, :] * X[1, :] - np.asarray(stage.slip)[None, :]
        objective = _objective(vehicle, config, stage, ds, scale, X, U, slowness.map(n)(X, k))
        nlp = {
            "x": ca.vertcat(ca.vec(X), ca.vec(U)),
            "f": objective / UNIT,
            "g": ca.vertcat(ca.vec(defects), (X[1, :] + X[4, :]).T, slip.T),
        }
        options = {"ipopt.print_level": 0, "print_time": False, "ipopt.max_iter": 1000, "ipopt.tol": tolerance,
                   "ipopt.sb": "yes"}  # fmt: skip
        with generated(compiled) as more:
            self._solver = ca.nlpsol("plan", "ipopt", nlp, options | more)
        self._bounds = _bounds(vehicle, config, stage, scale)

    def solve(self, guess: np.ndarray) -> PlanSolution:
        """Solve from `guess` (n, 7) in SI with zero input rates."""
        n = self.nodes
        start = _flat((guess / self.scale).T, np.zeros((2, n - 1)))
        out = self._solver(x0=start, **self._bounds)
        states = np.asarray(out["x"])[: 7 * n].reshape(n, 7) * self.scale
        return PlanSolution(states, float(out["f"]) * UNIT, bool(self._solver.stats()["success"]))


def _flat(A, B) -> np.ndarray:
    return np.concatenate([np.asarray(A).T.ravel(), np.asarray(B).T.ravel()])


def _step(v: VehicleConfig, ds: float, scale: np.ndarray) -> tuple[ca.Function, ca.Function]:
    """Return one RK4 step of `ds` [m] along the track, and the time per metre [s/m]."""
    x, u, kappa = ca.SX.sym("x", 7), ca.SX.sym("u", 2), ca.SX.sym("kappa", 3)

    def slope(x, kappa):
        V, beta, r, e, theta, delta, Fxr = ca.vertsplit(x * ca.DM(scale))
        s_dot = V * ca.cos(theta + beta) / (1 - e * kappa)
        rates = (*single_track(v, V, beta, r, delta, Fxr), V * ca.sin(theta + beta), r - kappa * s_dot,
                 u[0] * v.delta_rate_max, u[1] * v.Fxr_rate_max)  # fmt: skip
        return ca.vertcat(*rates) / ca.DM(scale) / s_dot, 1 / s_dot

    k1, slow = slope(x, kappa[0])
    k2 = slope(x + ds / 2 * k1, kappa[1])[0]
    k3 = slope(x + ds / 2 * k2, kappa[1])[0]
    k4 = slope(x + ds * k3, kappa[2])[0]
    step = ca.Function("step", [x, u, kappa], [x + ds / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    return step, ca.Function("slowness", [x, kappa], [slow])


def _objective(v: VehicleConfig, config: PlanConfig, stage: Stage, ds: float, scale: np.ndarray, X, U, slowness):
    """Return the time with its floor, and the costs of rates, course and front slip [s]."""
    share = np.asarray(stage.share)[None, :]
    floor = 0.0 if config.V_fair is None else 1 / config.V_fair
    time = ca.sum2(share * (slowness**16 + floor**16) ** (1 / 16)) * ds
    time += 0.1 * floor * ca.sum2(share * (X[0, :] * config.entry_speed * floor) ** 2) * ds
    penalty = config.rate_weight * ds / config.entry_speed * ca.sumsqr(U)
    penalty += config.course_weight * ds / config.entry_speed * ca.sum2(share * (X[1, :] + X[4, :]) ** 2)
    S = [X[i, :] * scale[i] for i in range(7)]
    front = ca.atan2(S[0] * ca.sin(S[1]) + v.a * S[2], S[0] * ca.cos(S[1])) - S[5]
    beyond = ca.fmax(ca.fabs(front) - np.tan(np.pi / (2 * v.C)) / v.B, 0)
    return time + penalty + config.front_slip * ds / config.entry_speed * ca.sum2(share * beyond**2)


def _bounds(v: VehicleConfig, config: PlanConfig, stage: Stage, scale: np.ndarray) -> dict[str, np.ndarray]:
    """Return the bounds of the variables and of defects, course and slip."""
    n = len(np.asarray(stage.share))
    at_end = np.full(n, 1.2)
    at_end[-1] = config.end_slip
    lbg = np.concatenate([np.zeros(7 * (n - 1)), -at_end, np.zeros(n)])
    ubg = np.concatenate([np.zeros(7 * (n - 1)), at_end, np.full(n, np.inf)])
    beta_max = np.array(stage.beta_max)
    beta_max[-1] = min(beta_max[-1], config.end_slip)
    free, one = np.full(n, np.inf), np.ones(n)
    upper = [config.V_max * one, beta_max, free, stage.e_max, free, v.delta_max * one, v.Fxr_max * one]
    lower = [config.V_min * one, -beta_max, -free, stage.e_min, -free, -v.delta_max * one, v.Fxr_min * one]
    upper, lower = np.stack(upper) / scale[:, None], np.stack(lower) / scale[:, None]
    lower[:, 0] = upper[:, 0] = np.array([config.entry_speed, 0, 0, 0, 0, 0, 0]) / scale
    full = np.ones((2, n - 1))
    return {"lbx": _flat(lower, -full), "ubx": _flat(upper, full), "lbg": lbg, "ubg": ubg}
