"""Plan the fastest way through a hairpin: where does the car drift?"""

import sys

import driftjax as dj

car, track = dj.load_vehicle("sedan", combined_slip=1.0), dj.load_track("sedan_corner")
plan = dj.plan(track, car)

print(dj.RESULTS[plan.result] or "solved", f"lap time {float(plan.lap_time):.2f} s")
print("drifts from and to [m]:", plan.drift_intervals())
dj.save_plan(plan, track, car, sys.argv[1] if len(sys.argv) > 1 else "runs/example-plan")  # plan.nc, plan.csv, figures
