"""Options of the paper's comparison."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

from driftjax.core import require, require_at_least

Car = Literal["sedan", "rc"]


@dataclass(frozen=True)
class PaperConfig:
    """Every method on the same plants and noise, with ablations."""

    cars: tuple[Car, ...] = ("sedan", "rc")
    """Cars to drive."""
    half: Literal["held_out", "development"] = "held_out"
    """Plants that no setting was chosen on, or those that settings are chosen on."""
    plants: int = 16
    """Plants in each half: numbers 0 to 15 of the distribution are for development, 16 to 31 are held out."""
    noise_seeds: int = 2
    """Noise seeds per plant."""
    seed: int = 6
    """Seed of plants and noise."""
    ablations: bool = True
    """Also drive the ablations."""
    ablation_plants: int = 4
    """Plants of each ablation, one noise seed."""
    quick: bool = False
    """Four plants, one noise seed, the main comparison only."""

    def __post_init__(self) -> None:
        require(len(self.cars) > 0, "key 'cars' is empty; name sedan, rc or both.")
        require_at_least(self, 1, "plants", "noise_seeds", "ablation_plants")
        require_at_least(self, 0, "seed")

    @property
    def first_plant(self) -> int:
        """Number of the half's first plant."""
        return self.plants if self.half == "held_out" else 0

    def reduced(self) -> "PaperConfig":
        """Return the reduced configuration of `quick`."""
        return dataclasses.replace(self, noise_seeds=1, ablations=False)
