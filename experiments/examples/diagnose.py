"""Hide an effect in a simulated car, then ask its log what the nominal car gets wrong."""

import sys

import driftjax as dj

out, car = sys.argv[1] if len(sys.argv) > 1 else "runs/example-diagnose", dj.load_vehicle("sedan", combined_slip=1.0)
runs, truth = dj.record_runs(car, dj.effect_strengths(car, ["yaw_inertia=2"]), dj.Campaign(seed=3))
diagnosis = dj.diagnose(car, dj.Log(runs))
print(diagnosis.verdict, diagnosis.sentence)
print([(cause.effect, cause.probability) for cause in diagnosis.causes], "hidden:", truth.effects)
print(diagnosis.extended)  # the car with what was found, ready for plan, equilibria, DriftMPC and learn
diagnosis.save(out)  # diagnosis.json, extended.yaml, diagnosis.nc
