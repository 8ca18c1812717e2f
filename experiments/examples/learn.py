"""Learn to drift on two plants: nominal laps, laps with a Gaussian process, active exploration."""

import dataclasses
import sys

import driftjax as dj

config = dj.load_learn_config("sedan")  # everything the command line offers
config = dataclasses.replace(config, plants=2, seed=3, gpr_laps=1, compare=False)
config = dataclasses.replace(config, explore=dataclasses.replace(config.explore, laps=1))
run = dj.learn(config, sys.argv[1] if len(sys.argv) > 1 else "runs/example-learn", workers=1)
print(run.laps.lateral_error)  # per stage and lap [m]; run.results holds the summary
