"""The drift MPC's transcription written a second time, in CasADi for IPOPT, in rad and kN."""

import casadi as ca
import numpy as np

G = 9.81


def _rates(v, x, u):
    """Rates of the published single track; force in kN."""
    V, beta, r, delta, Fxr = x[0], x[1], x[2], u[0], 1000 * u[1]
    L = v.a + v.b
    Fzf, Fzr = v.m * G * v.b / L, v.m * G * v.a / L
    vx, vy = V * ca.cos(beta), V * ca.sin(beta)
    shape = lambda alpha: ca.sin(v.C * ca.atan(v.B * alpha))
    Fyf = -v.mu * Fzf * shape(ca.atan2(vy + v.a * r, vx) - delta)
    Fyr = -v.mu * Fzr * shape(ca.atan2(vy - v.b * r, vx))
    return ca.vertcat(
        (-Fyf * ca.sin(delta - beta) + Fyr * ca.sin(beta) + Fxr * ca.cos(beta)) / v.m,
        (Fyf * ca.cos(delta - beta) + Fyr * ca.cos(beta) - Fxr * ca.sin(beta)) / (v.m * V) - r,
        (v.a * Fyf * ca.cos(delta) - v.b * Fyr) / v.Iz,
    )


def solver(v, config, weights, x_ref):
    """Function of (x0 (3,), previous (2,) in rad and kN) that gives the optimal cost and IPOPT's success."""
    N, dt = config.horizon, config.dt
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    k1 = _rates(v, x, u)
    k2 = _rates(v, x + dt / 2 * k1, u)
    k3 = _rates(v, x + dt / 2 * k2, u)
    k4 = _rates(v, x + dt * k3, u)
    step = ca.Function("step", [x, u], [x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    X, U = ca.MX.sym("X", 3, N), ca.MX.sym("U", 2, N)
    x0, previous = ca.MX.sym("x0", 3), ca.MX.sym("previous", 2)
    states = ca.horzcat(x0, X)
    change = U - ca.horzcat(previous, U[:, :-1])
    error = states - ca.repmat(ca.DM(x_ref), 1, N + 1)
    cost = ca.sum1(ca.DM(weights.Q).T @ error**2 @ ca.DM.ones(N + 1, 1))
    cost = cost + ca.sum1(ca.DM(config.R).T @ change**2 @ ca.DM.ones(N, 1))
    g = ca.vertcat(ca.vec(step.map(N)(states[:, :-1], U) - X), ca.vec(change))
    nlp = {"x": ca.vertcat(ca.vec(X), ca.vec(U)), "p": ca.vertcat(x0, previous), "f": cost, "g": g}
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": 1e-8}
    ipopt = ca.nlpsol("drift_mpc", "ipopt", nlp, options)
    rate = np.tile(dt * np.array([v.delta_rate_max, v.Fxr_rate_max / 1000]), N)
    lbg, ubg = np.concatenate([np.zeros(3 * N), -rate]), np.concatenate([np.zeros(3 * N), rate])
    free = np.full(3 * N, np.inf)
    lbx = np.concatenate([-free, np.tile([-v.delta_max, v.Fxr_min / 1000], N)])
    ubx = np.concatenate([free, np.tile([v.delta_max, v.Fxr_max / 1000], N)])

    def run(start, before):
        guess = np.concatenate([np.tile(x_ref, N), np.tile(before, N)])
        out = ipopt(x0=guess, p=np.concatenate([start, before]), lbx=lbx, ubx=ubx, lbg=lbg, ubg=ubg)
        return float(out["f"]), bool(ipopt.stats()["success"])

    return run
