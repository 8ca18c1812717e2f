"""Cars: the paper's nominal single track, extended cars, and the double-track plant."""

from driftjax.vehicle.corrected import Corrected as Corrected
from driftjax.vehicle.corrected import Residual as Residual
from driftjax.vehicle.corrected import no_residual as no_residual
from driftjax.vehicle.double_track import DoubleTrack as DoubleTrack
from driftjax.vehicle.double_track import Motion as Motion
from driftjax.vehicle.double_track import PlantState as PlantState
from driftjax.vehicle.effect import effects_by_name as effects_by_name
from driftjax.vehicle.extended import AnyCar as AnyCar
from driftjax.vehicle.extended import Extended as Extended
from driftjax.vehicle.extended import actuator_lags as actuator_lags
from driftjax.vehicle.extended import beyond_peak as beyond_peak
from driftjax.vehicle.extended import build_car as build_car
from driftjax.vehicle.extended import require_steady as require_steady
from driftjax.vehicle.extended import unmodelled_effects as unmodelled_effects
from driftjax.vehicle.load import load_vehicle as load_vehicle
from driftjax.vehicle.load import with_effects as with_effects
from driftjax.vehicle.load import write_vehicle as write_vehicle
from driftjax.vehicle.parameters import EffectParameterValue as EffectParameterValue
from driftjax.vehicle.parameters import EstimatedNoise as EstimatedNoise
from driftjax.vehicle.parameters import PerChannel as PerChannel
from driftjax.vehicle.parameters import VehicleConfig as VehicleConfig
from driftjax.vehicle.plant_config import PlantConfig as PlantConfig
from driftjax.vehicle.plants import draw_plants as draw_plants
from driftjax.vehicle.plants import load_plant as load_plant
from driftjax.vehicle.plants import stack_plants as stack_plants
from driftjax.vehicle.single_track import SingleTrack as SingleTrack
