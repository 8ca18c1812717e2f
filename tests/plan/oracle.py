"""The planner's transcription written a second time, in CasADi for IPOPT: independent derivatives and solver."""

import casadi as ca
import numpy as np

G = 9.81


def single_track(v, V, beta, r, delta, Fxr):
    """Rates of the paper's car, from the parameters in a vehicle config."""
    L = v.a + v.b
    Fzf, Fzr = v.m * G * v.b / L, v.m * G * v.a / L
    vx, vy = V * ca.cos(beta), V * ca.sin(beta)
    alpha_f, alpha_r = ca.atan2(vy + v.a * r, vx) - delta, ca.atan2(vy - v.b * r, vx)
    shape = lambda alpha: ca.sin(v.C * ca.atan(v.B * alpha))
    Fyf, Fyr = -v.mu * Fzf * shape(alpha_f), -v.mu * Fzr * shape(alpha_r)
    Fyr *= ca.sqrt(ca.fmax(1 - (v.combined_slip * Fxr / (v.mu * Fzr)) ** 2, 0.04))
    return (
        (-Fyf * ca.sin(delta - beta) + Fyr * ca.sin(beta) + Fxr * ca.cos(beta)) / v.m,
        (Fyf * ca.cos(delta - beta) + Fyr * ca.cos(beta) - Fxr * ca.sin(beta)) / (v.m * V) - r,
        (v.a * Fyf * ca.cos(delta) - v.b * Fyr) / v.Iz,
    )


def solve(vehicle, config, stage, ds, guess, scale, max_iter=1000):
    """IPOPT's answer from `guess` (n, 7): states (n, 7) in SI, objective in seconds, success."""
    v, lim, n = vehicle, config, len(guess)
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
    slowness = ca.Function("slowness", [x, kappa], [slow])
    k = np.asarray(stage.kappa).T
    X, U = ca.MX.sym("X", 7, n), ca.MX.sym("U", 2, n - 1)
    defects = step.map(n - 1)(X[:, :-1], U, k[:, :-1]) - X[:, 1:]
    share = np.asarray(stage.share)[None, :]
    floor = 0.0 if config.V_fair is None else 1 / config.V_fair
    time = ca.sum2(share * (slowness.map(n)(X, k) ** 16 + floor**16) ** (1 / 16)) * ds
    time += 0.1 * floor * ca.sum2(share * (X[0, :] * config.entry_speed * floor) ** 2) * ds
    price = config.rate_weight * ds / config.entry_speed * ca.sumsqr(U)
    price += config.course_weight * ds / config.entry_speed * ca.sum2(share * (X[1, :] + X[4, :]) ** 2)
    S = [X[i, :] * scale[i] for i in range(7)]
    front = ca.atan2(S[0] * ca.sin(S[1]) + v.a * S[2], S[0] * ca.cos(S[1])) - S[5]
    beyond = ca.fmax(ca.fabs(front) - np.tan(np.pi / (2 * v.C)) / v.B, 0)
    price += config.front_slip * ds / config.entry_speed * ca.sum2(share * beyond**2)
    course = X[1, :] + X[4, :]
    slip = -np.asarray(stage.side)[None, :] * X[1, :] - np.asarray(stage.slip)[None, :]
    g = ca.vertcat(ca.vec(defects), course.T, slip.T)
    at_end = np.full(n, 1.2)
    at_end[-1] = lim.end_slip
    lbg = np.concatenate([np.zeros(7 * (n - 1)), -at_end, np.zeros(n)])
    ubg = np.concatenate([np.zeros(7 * (n - 1)), at_end, np.full(n, np.inf)])
    beta_max = np.array(stage.beta_max)
    beta_max[-1] = min(beta_max[-1], lim.end_slip)
    free, one = np.full(n, np.inf), np.ones(n)
    upper = [lim.V_max * one, beta_max, free, stage.e_max, free, v.delta_max * one, v.Fxr_max * one]
    lower = [lim.V_min * one, -beta_max, -free, stage.e_min, -free, -v.delta_max * one, v.Fxr_min * one]
    upper, lower = np.stack(upper) / scale[:, None], np.stack(lower) / scale[:, None]
    lower[:, 0] = upper[:, 0] = np.array([lim.entry_speed, 0, 0, 0, 0, 0, 0]) / scale
    flat = lambda A, B: np.concatenate([np.asarray(A).T.ravel(), np.asarray(B).T.ravel()])
    full = np.ones((2, n - 1))
    nlp = {"x": ca.vertcat(ca.vec(X), ca.vec(U)), "f": (time + price) * 10, "g": g}
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.max_iter": max_iter, "ipopt.tol": 1e-8,
               "ipopt.sb": "yes"}  # fmt: skip
    solver = ca.nlpsol("oracle", "ipopt", nlp, options)
    start = flat((guess / scale).T, np.zeros((2, n - 1)))
    out = solver(x0=start, lbx=flat(lower, -full), ubx=flat(upper, full), lbg=lbg, ubg=ubg)
    states = np.asarray(out["x"])[: 7 * n].reshape(n, 7) * scale
    return states, float(out["f"]) / 10, solver.stats()
