"""Independent transcription of the drift MPC in CasADi for FATROP and IPOPT, in rad and kN.

Stage k has (V, beta, r, last input) and the input; defects are ordered stage by stage, as FATROP requires. IPOPT too is
faster in this form than without the last inputs.
"""

import time
from typing import NamedTuple

import casadi as ca
import numpy as np

from driftjax.control.mpc import MPCConfig, Weights
from driftjax.studies.bench.casadi_car import generated, single_track
from driftjax.studies.bench.config import Solver
from driftjax.vehicle import VehicleConfig

KN = np.array([1.0, 1000.0])
QUIET = {"fatrop": {"fatrop.print_level": 0}, "ipopt": {"ipopt.print_level": 0, "ipopt.sb": "yes"}}


class CasadiSolution(NamedTuple):
    """Result of one solve."""

    cost: float
    success: bool
    seconds: float


def _step(v: VehicleConfig, dt: float) -> ca.Function:
    """Return one RK4 step of (V, beta, r, last input) with forces in kN."""
    x, last, u = ca.SX.sym("x", 3), ca.SX.sym("last", 2), ca.SX.sym("u", 2)
    rates = lambda x: ca.vertcat(*single_track(v, x[0], x[1], x[2], u[0], 1000 * u[1]))
    k1 = rates(x)
    k2 = rates(x + dt / 2 * k1)
    k3 = rates(x + dt / 2 * k2)
    k4 = rates(x + dt * k3)
    return ca.Function("step", [ca.vertcat(x, last), u], [ca.vertcat(x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), u)])


class CasadiMPC:
    """The drift MPC for one CasADi solver: `compiled` to C by gcc, or evaluated by CasADi."""

    def __init__(
        self,
        solver: Solver,
        v: VehicleConfig,
        config: MPCConfig,
        weights: Weights,
        x_ref: np.ndarray,
        tolerance: float,
        compiled: bool = True,
    ):
        self.horizon, self.x_ref = config.horizon, x_ref
        nlp, equality, self.bounds = _transcription(v, config, weights, x_ref)
        options = {"print_time": False, f"{solver}.tol": tolerance} | QUIET[solver]
        if solver == "fatrop":
            options |= {"structure_detection": "auto", "equality": equality}
        with generated(compiled) as more:
            self.solver = ca.nlpsol("drift_mpc", solver, nlp, options | more)

    def solve(self, x: np.ndarray, previous: np.ndarray) -> CasadiSolution:
        """Solve from `x` (3,) and the last command `previous` (2,) in rad and N; the guess is the reference."""
        before = previous / KN
        stage = np.concatenate([self.x_ref, before, before])
        guess = np.concatenate([np.tile(stage, self.horizon), stage[:5]])
        start = time.perf_counter()
        out = self.solver(x0=guess, p=np.concatenate([x, before]), **self.bounds)
        seconds = time.perf_counter() - start
        return CasadiSolution(float(out["f"]), bool(self.solver.stats()["success"]), seconds)


def _transcription(v: VehicleConfig, config: MPCConfig, weights: Weights, x_ref: np.ndarray):
    """Return the problem, which constraints are equalities, and the bounds."""
    step, N = _step(v, config.dt), config.horizon
    X = [ca.MX.sym(f"X{k}", 5) for k in range(N + 1)]
    U = [ca.MX.sym(f"U{k}", 2) for k in range(N)]
    start = ca.MX.sym("start", 5)
    rate = config.dt * np.array([v.delta_rate_max, v.Fxr_rate_max]) / KN
    low, high = np.array([-v.delta_max, v.Fxr_min]) / KN, np.array([v.delta_max, v.Fxr_max]) / KN
    zero, free = np.zeros(5), np.full(5, np.inf)
    tracking = lambda x: ca.dot(ca.DM(weights.Q), (x[:3] - x_ref) ** 2)
    cost, constraints, bounds = tracking(X[N]), [], []
    for k in range(N):
        change = U[k] - X[k][3:]
        constraints += [X[k + 1] - step(X[k], U[k]), *([X[0] - start] if k == 0 else []), change]
        bounds += [(zero, zero)] * (1 + (k == 0)) + [(-rate, rate)]
        cost += tracking(X[k]) + ca.dot(ca.DM(config.R), change**2)
    lbg, ubg = (np.concatenate(side) for side in zip(*bounds, strict=True))
    lbx, ubx = np.tile(np.concatenate([-free, low]), N), np.tile(np.concatenate([free, high]), N)
    variables = [part for pair in zip(X, U, strict=False) for part in pair] + [X[N]]
    nlp = {"x": ca.vertcat(*variables), "p": start, "f": cost, "g": ca.vertcat(*constraints)}
    sides = {"lbx": np.append(lbx, -free), "ubx": np.append(ubx, free), "lbg": lbg, "ubg": ubg}
    return nlp, (lbg == ubg).tolist(), sides
