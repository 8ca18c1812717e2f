"""Solve for all steady states of a car at one speed and yaw rate: here drifts, with and without countersteer."""

import numpy as np

import driftjax as dj

states = dj.equilibria(dj.load_vehicle("sedan"), V=[9.0], r=[1.1])
for root in np.flatnonzero(states.branch[0] >= 0):
    one = states.isel(point=0, root=root)
    name, (beta, delta) = dj.Branch(int(one.branch)).name.lower(), np.rad2deg([one.beta, one.delta])
    print(f"{name}: beta {beta:.1f} deg, delta {delta:.1f} deg, Fxr {float(one.Fxr):.0f} N")
