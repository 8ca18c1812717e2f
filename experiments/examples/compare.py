"""Drive like manoeuvres on two cars, one with less grip at the rear, and compare their logs."""

import sys

import driftjax as dj

out, car = sys.argv[1] if len(sys.argv) > 1 else "runs/example-compare", dj.load_vehicle("sedan", combined_slip=1.0)
before, after = ["gyro_bias=1"], ["gyro_bias=1", "friction_rear=-1"]  # both logs have the biased gyro
logs = []
for seed, effects in enumerate((before, after)):
    campaign = dj.Campaign(("drift", "slalom"), duration=6.0, seed=seed)
    logs.append(dj.Log(dj.record_runs(car, dj.effect_strengths(car, effects), campaign)[0]))
comparison = dj.compare(car, *logs)
print(comparison.verdict, comparison.sentence)
comparison.save(out)  # compare.json
