"""Simulate closed-loop laps and open-loop runs of the plant, with sensors and noise."""

from driftjax.sim.drive_laps import drive_laps as drive_laps
from driftjax.sim.lap import LapCode as LapCode
from driftjax.sim.lap import LapConfig as LapConfig
from driftjax.sim.lap import Laps as Laps
from driftjax.sim.lap import Sensed as Sensed
from driftjax.sim.lap import Trace as Trace
from driftjax.sim.lap import drive as drive
from driftjax.sim.lap import where_tree as where_tree
from driftjax.sim.plant_files import batch_of as batch_of
from driftjax.sim.plant_files import load_any_plant as load_any_plant
from driftjax.sim.plant_files import load_plants as load_plants
from driftjax.sim.simulate import simulate as simulate
from driftjax.sim.universal_plant import AnyPlant as AnyPlant
from driftjax.sim.universal_plant import plant_of as plant_of
