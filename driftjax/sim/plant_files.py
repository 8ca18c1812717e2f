"""Load plants by name or file: double-track plants of a plant YAML, or cars with effects of a vehicle YAML."""

from collections.abc import Sequence
from pathlib import Path

from driftjax.core import BadInput, find_config, read_yaml
from driftjax.sim.universal_plant import AnyPlant, plants_of
from driftjax.vehicle import PlantConfig, VehicleConfig, load_plant, load_vehicle, stack_plants

OF_A_VEHICLE = {"nominal", "mu"}  # keys that no plant YAML has


def load_any_plant(name: str | Path) -> PlantConfig | VehicleConfig:
    """Load a shipped plant or plant YAML, or the car of a vehicle YAML such as an extended.yaml."""
    path = find_config("plant", name)
    return load_vehicle(path) if read_yaml(path).keys() & OF_A_VEHICLE else load_plant(path)


def load_plants(names: Sequence[str | Path]) -> list[PlantConfig] | list[VehicleConfig]:
    """Load several plants with `load_any_plant`; raises `BadInput` for mixed kinds, as one program drives them all."""
    plants, vehicles = by_kind([load_any_plant(name) for name in names])
    if plants and vehicles:
        raise BadInput(f"plants: '{plants[0].name}' is a plant, '{vehicles[0].name}' a vehicle file; give one kind.")
    return vehicles or plants


def batch_of(configs: Sequence[PlantConfig | VehicleConfig], lap: float, step: float) -> AnyPlant:
    """Build a batch of plants of one kind, in this order, for a lap of `lap` [m] integrated in steps of `step` [s]."""
    plants, vehicles = by_kind(configs)
    return plants_of(vehicles, lap, step) if vehicles else stack_plants(plants)


def by_kind(configs: Sequence[PlantConfig | VehicleConfig]) -> tuple[list[PlantConfig], list[VehicleConfig]]:
    """Split configurations into plant files and vehicle files."""
    plants = [one for one in configs if isinstance(one, PlantConfig)]
    return plants, [one for one in configs if isinstance(one, VehicleConfig)]
