"""Learn to drift on one plant: nominal lap, laps with a Gaussian process, active exploration."""

import dataclasses
import sys

import driftjax as dj

config = dataclasses.replace(dj.load_learn_config("rc"), plants=1, gpr_laps=1, compare=False)
config = dataclasses.replace(config, explore=dataclasses.replace(config.explore, laps=1))
run = dj.learn(config, sys.argv[1] if len(sys.argv) > 1 else "runs/example-learn", workers=1)
print(run.laps.lateral_error.mean("lane"))  # per stage [m]
