"""Simulate three cars that differ from each other, under the same commands."""

import numpy as np

import driftjax as dj

plants = dj.draw_plants("sedan", 3, seed=1)  # double-track cars drawn around the sedan
steering, force = np.full(150, 0.08), np.linspace(0, 6000, 150)  # [rad], [N]
data = dj.simulate(plants, np.stack([steering, force], axis=1), dt=0.02, start=(12.0, 0.0, 0.0))

print(data)  # an xarray.Dataset with units
print("sideslip after 3 s [deg]:", np.rad2deg(data.beta.isel(time=-1).values).round(1))
