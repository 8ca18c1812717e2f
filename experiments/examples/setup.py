"""Choose where compiled programs are kept; float64 is set up by importing the package."""

import sys

import driftjax as dj

dj.setup(cache=sys.argv[1] if len(sys.argv) > 1 else "~/.cache/driftjax")
print(dj.load_vehicle("sedan"))  # shipped: sedan, rc, dart, ...; or the path of a YAML
print(dj.load_plant("rc"))  # a richer car, to be simulated in place of the real one
print([plant.name for plant in dj.draw_plants("sedan", 3, seed=1)])
