"""Solve the drift MPC for a batch of states around a steady drift, warm-started, and differentiate it."""

import jax
import jax.numpy as jnp
import numpy as np

import driftjax as dj

car, (V, r) = dj.load_vehicle("sedan"), (9.0, 1.1)
states = dj.equilibria(car, [V], [r]).isel(point=0)
drift = states.isel(root=int((states.branch == dj.Branch.COUNTERSTEER).argmax("root")))
beta, u = float(drift.beta), np.array([drift.delta, drift.Fxr])
mpc, x = dj.DriftMPC(car), jnp.array([V, beta, r, 0.0, -beta])
reference, guess = dj.steady_reference(V, beta, r, mpc.horizon), np.tile(u, (mpc.horizon, 1))
batch = dj.mpc_state(x + np.random.default_rng(0).normal(0, 0.03, (4, 5)), u)
solution = mpc.solve(batch, reference, guess)
print("steering [rad]:", solution.u.delta, "converged:", solution.plan.result == dj.RESULTS.successful)
print("one step later:", mpc.solve(batch, reference, solution).u.delta)
print("derivative by state:", jax.jacfwd(lambda x: mpc.solve(dj.mpc_state(x, u), reference, guess).u.delta)(x))
