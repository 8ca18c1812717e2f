"""Solve for all steady states of a car at one speed and yaw rate: cornering with grip and drifts."""

import numpy as np

import driftjax as dj

car = dj.load_vehicle("sedan")
states = dj.equilibria(car, V=[10.0], r=[0.98])
for root in np.flatnonzero(states.branch[0] >= 0):
    one = states.isel(point=0, root=root)
    name, (beta, delta) = dj.Branch(int(one.branch)).name.lower(), np.rad2deg([one.beta, one.delta])
    print(f"{name}: beta {beta:.1f} deg, delta {delta:.1f} deg, Fxr {float(one.Fxr):.0f} N")
