"""Fit what one believes a car to have, such as its tyres, to a log of gentle driving; keep the calibrated car."""

import sys

import driftjax as dj

out, car = sys.argv[1] if len(sys.argv) > 1 else "runs/example-calibrate", dj.load_vehicle("sedan", combined_slip=1.0)
hidden = dj.effect_strengths(car, ["stiffness_front=-1", "steer_offset=1"])
campaign = dj.Campaign(("slalom", "grip_sine", "step_steer") * 2, duration=6.0, seed=4)
runs, truth = dj.record_runs(car, hidden, campaign)
calibration = dj.calibrate(car, dj.Log(runs), ("stiffness_front", "stiffness_rear", "steer_offset"))
print(calibration, "hidden:", truth.effects)
calibration.save(out)  # calibrated.yaml, calibration.json
