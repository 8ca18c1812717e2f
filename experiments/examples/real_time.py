"""Drive with the drift MPC at a fixed rate, in two halves; `dj.export_mpc` writes both for use without this package."""

import jax.numpy as jnp
import numpy as np

import driftjax as dj

V, beta, r, u = 9.0, -0.545, 1.1, np.array([-0.297, 6850.0])  # a drift of the sedan
mpc, x = dj.DriftMPC(dj.load_vehicle("sedan")), jnp.array([V + 0.2, beta, r, 0.0, -beta])
reference, plan = dj.steady_reference(V, beta, r, mpc.horizon), np.tile(u, (mpc.horizon, 1))
for _ in range(3):
    prepared = mpc.prepare(dj.mpc_state(x, u), reference, plan)  # before the next measurement
    plan = mpc.respond(prepared, dj.mpc_state(x, u))  # after it
    u, x = np.array([plan.u.delta, plan.u.Fxr]), plan.X[1]  # here the car does what the model says
    print("steering [rad], force [N]:", u, "error of the program:", plan.response.error)
    print("of the problem:", mpc.judge(prepared, plan))  # when there is time
