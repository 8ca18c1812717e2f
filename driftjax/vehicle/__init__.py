"""Cars: the paper's nominal single track and the plant that stands in for the real one."""

from driftjax.vehicle.corrected import Corrected as Corrected
from driftjax.vehicle.parameters import VehicleConfig as VehicleConfig
from driftjax.vehicle.parameters import load_vehicle as load_vehicle
from driftjax.vehicle.single_track import SingleTrack as SingleTrack
