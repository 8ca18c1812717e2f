"""Write a log, read it back with its checks, and see whether its channels agree."""

import sys
from pathlib import Path

import driftjax as dj

out = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example-log.csv")
car = dj.load_vehicle("sedan", combined_slip=1.0)
runs, truth = dj.record_runs(car, dj.effect_strengths(car), dj.Campaign(("slalom",), duration=5.0))
dj.write_log(out, runs)
log = dj.read_log(out)  # CSV, Parquet, ROS bags, MCAP, MDF; `columns` maps foreign names
print(dj.inspect(log, wheelbase=car.a + car.b))
