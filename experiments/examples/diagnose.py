"""Hide an effect in a simulated car, and diagnose from its log what the nominal car gets wrong."""

import sys

import driftjax as dj

out, car = sys.argv[1] if len(sys.argv) > 1 else "runs/example-diagnose", dj.load_vehicle("sedan", combined_slip=1.0)
campaign = dj.Campaign(("drift", "grip_sine", "slalom", "drift", "throttle_steps", "laps"), duration=6.0, seed=3)
runs, truth = dj.record_runs(car, dj.effect_strengths(car, ["yaw_inertia=2"]), campaign)
diagnosis = dj.diagnose(car, dj.Log(runs), dj.DiagnoseConfig(gp=False))
print(diagnosis.verdict, diagnosis.sentence, "hidden:", truth.effects)
print([(cause.effect, cause.probability, cause.parameters) for cause in diagnosis.causes])
print(diagnosis.extended.effects)  # the car with what was found, ready for plan, equilibria, DriftMPC and learn
diagnosis.save(out)  # diagnosis.json, extended.yaml; dj.write_diagnosis(out) would add the page report.html
