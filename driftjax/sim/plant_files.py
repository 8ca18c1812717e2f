"""Plants by name or file: richer cars of a plant YAML, or cars with effects of a vehicle YAML."""

from collections.abc import Sequence
from pathlib import Path

from driftjax.core import BadInput, find_config, read_yaml
from driftjax.sim.universal_plant import AnyPlant, plants_of
from driftjax.vehicle import PlantConfig, VehicleConfig, load_plant, load_vehicle, stack_plants

OF_A_VEHICLE = {"nominal", "mu"}  # keys that no plant YAML holds


def load_any_plant(name: str | Path) -> PlantConfig | VehicleConfig:
    """The plant of a shipped name or plant YAML, or the car of a vehicle YAML such as an extended.yaml."""
    path = find_config("plant", name)
    return load_vehicle(path) if read_yaml(path).keys() & OF_A_VEHICLE else load_plant(path)


def batch_of(configs: Sequence[PlantConfig | VehicleConfig], lap: float, step: float) -> AnyPlant:
    """A batch of plants in the order of `configs`, all of one kind; for a lap of `lap` metres, in steps of `step` s."""
    plants = [one for one in configs if isinstance(one, PlantConfig)]
    vehicles = [one for one in configs if isinstance(one, VehicleConfig)]
    if plants and vehicles:
        raise BadInput(f"plants: '{plants[0].name}' is a plant, '{vehicles[0].name}' a vehicle file; give one kind.")
    return plants_of(vehicles, lap, step) if vehicles else stack_plants(plants)
