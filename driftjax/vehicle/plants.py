"""Shipped plants, random plants from a distribution, and batches of plants."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr, ndtri

from driftjax.core import BadInput, find_config, from_dict, read_yaml, require, shown
from driftjax.vehicle.double_track import DoubleTrack
from driftjax.vehicle.plant_config import PlantConfig

SHARED = ("mu", "mu_difference")  # keys of a distribution that set both axles


@dataclass(frozen=True)
class Spread:
    """Distribution of one parameter over plants: set exactly one of the two."""

    uniform: tuple[float, float] | None = None
    """Lowest and highest value."""
    normal: tuple[float, float] | None = None
    """Mean and standard deviation; draws stay within two standard deviations."""

    def __post_init__(self) -> None:
        require((self.uniform is None) != (self.normal is None), "give either 'uniform' or 'normal'.")
        low, high = self.limits
        require(low <= high, f"the range {low} to {high} is empty; order it, with no negative deviation.")

    @property
    def limits(self) -> tuple[float, float]:
        """Return the lowest and highest value that can be drawn."""
        if self.uniform is not None:
            return self.uniform
        mean, deviation = self.normal or (0.0, 0.0)
        return mean - 2 * deviation, mean + 2 * deviation

    def draw(self, generator: np.random.Generator) -> float:
        """Draw one value; uses exactly one uniform number from `generator`."""
        share = generator.random()
        if self.uniform is not None:
            return self.uniform[0] + share * (self.uniform[1] - self.uniform[0])
        mean, deviation = self.normal or (0.0, 0.0)
        return float(mean + deviation * ndtri(ndtr(-2) + share * (ndtr(2) - ndtr(-2))))


def load_plant(name: str | Path) -> PlantConfig:
    """Read a plant YAML: a path, or a shipped name; a key `base` names the plant whose other values it takes.

    SI and radians. Raises `BadInput` that names file and key.
    """
    path = find_config("plant", name)
    return from_dict(PlantConfig, _resolved(path), str(path))


def _resolved(path: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    values = read_yaml(path)
    if isinstance(tyre := values.get("tyre"), str):
        values["tyre"] = str(path.parent / tyre)
    base = values.pop("base", None)
    if base is None:
        return values
    under = find_config("plant", path.parent / f"{base}.yaml")
    if under in (*above, path):
        raise BadInput(f"{path}: key 'base' leads back to {under.name}; name another plant.")
    return _resolved(under, (*above, path)) | values


def load_distribution(car: str) -> tuple[PlantConfig, dict[str, Spread]]:
    """Load base plant and parameter distributions from `configs/plant/<car>_distribution.yaml`.

    Shipped are `sedan`, `rc` and, wider and not centred on the nominal car, `sedan_wide` and `rc_wide`.
    """
    try:
        path = find_config("plant", f"{car}_distribution")
    except BadInput:
        raise BadInput(f"car '{car}' has no plants to draw from, no {car}_distribution.yaml; give --plant.") from None
    values = read_yaml(path)
    base = load_plant(str(values.pop("base", car)))
    known = {field.name for field in dataclasses.fields(PlantConfig)} - {"name", "tyre"} | set(SHARED)
    spreads = {}
    for key, spread in values.items():
        if key not in known:
            raise BadInput(f"{path}: unknown key '{key}'; known keys are {', '.join(sorted(known))}.")
        if not isinstance(spread, dict):
            raise BadInput(f"{path}: key '{key}' is {shown(spread)}; write 'uniform: [low, high]' or "
                           "'normal: [mean, sd]'.")  # fmt: skip
        spreads[key] = from_dict(Spread, spread, f"{path}: key '{key}'")
    return base, spreads


def draw_plants(car: str, num: int, seed: int, first: int = 0) -> list[PlantConfig]:
    """Draw `num` plants of `car` from number `first` on; plant i depends only on `seed` and i.

    The distributions are those of `configs/plant/<car>_distribution.yaml`; there `mu` is the mean friction of the axles
    and `mu_difference` front minus rear over that mean. Raises `BadInput` for a car without distributions.
    """
    base, spreads = load_distribution(car)
    plants = []
    for index in range(first, first + num):
        generator = np.random.default_rng([seed, index])
        drawn = {key: spreads[key].draw(generator) for key in sorted(spreads)}
        mu = drawn.pop("mu", (base.muf + base.mur) / 2)
        half = drawn.pop("mu_difference", 0.0) / 2
        if set(SHARED) & set(spreads):
            drawn |= {"muf": mu * (1 + half), "mur": mu * (1 - half)}
        plants.append(dataclasses.replace(base, name=f"{car}_{seed}_{index}", **drawn))
    return plants


def stack_plants(configs: Sequence[PlantConfig]) -> DoubleTrack:
    """Stack plants into one batch: every leaf has a leading batch axis, in the order of `configs`."""
    require(len(configs) > 0, "no plants to stack; give at least one.")
    plants = [config.build() for config in configs]
    if len({jax.tree.structure(plant) for plant in plants}) > 1:
        raise BadInput(
            "plants: their tyres are of different kinds or versions; drive those of each kind by themselves."
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *plants)
