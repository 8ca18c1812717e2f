"""Solve the drift MPC for a batch of states around a steady drift, and differentiate a command."""

import jax
import numpy as np

import driftjax as dj

car = dj.load_vehicle("sedan", combined_slip=1.0)
drift = dj.equilibria(car, V=[10.0], r=[0.98]).isel(point=0).where(lambda d: d.branch == dj.Branch.COUNTERSTEER, drop=True)
x, u = dj.State(10.0, float(drift.beta[0]), 0.98), np.array([drift.delta[0], drift.Fxr[0]])
mpc, around = dj.DriftMPC(car), np.array([10.0, x.beta, 0.98, 0.0, -x.beta])
reference, guess = dj.steady_reference(x, mpc.horizon), np.tile(u, (mpc.horizon, 1))
states = dj.mpc_state(around + np.random.default_rng(0).normal(0, 0.03, (4, 5)), u)
solution = mpc.solve(states, reference, guess)
print("steering commands [rad]:", solution.u.delta, "converged:", solution.plan.result == dj.RESULTS.successful)
steer = jax.jacfwd(lambda beta: mpc.solve(dj.mpc_state(jax.numpy.asarray(around).at[1].set(beta), u), reference, guess).u.delta)
print("steering by sideslip [rad/rad]:", steer(x.beta))
