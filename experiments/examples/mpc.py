"""Solve the drift MPC for a batch of states around a steady drift, warm-started, and differentiate it."""

import jax
import jax.numpy as jnp
import numpy as np

import driftjax as dj

car = dj.load_vehicle("sedan")
states = dj.equilibria(car, V=[10.0], r=[0.98]).stack(all=("point", "root"))
beta, delta, Fxr = (
    float(states[name][states.branch == dj.Branch.COUNTERSTEER][0]) for name in ("beta", "delta", "Fxr")
)
mpc, u, x = dj.DriftMPC(car), np.array([delta, Fxr]), jnp.array([10.0, beta, 0.98, 0.0, -beta])
reference, guess = dj.steady_reference(10.0, beta, 0.98, mpc.horizon), np.tile(u, (mpc.horizon, 1))
batch = dj.mpc_state(x + np.random.default_rng(0).normal(0, 0.03, (4, 5)), u)
solution = mpc.solve(batch, reference, guess)
print("steering [rad]:", solution.u.delta, "converged:", solution.plan.result == dj.RESULTS.successful)
print("one step later:", mpc.solve(batch, reference, solution).u.delta)
print("derivative by state:", jax.jacfwd(lambda x: mpc.solve(dj.mpc_state(x, u), reference, guess).u.delta)(x))
