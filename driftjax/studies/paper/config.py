"""Options of the paper's comparison."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

from driftjax.core import require, require_at_least, shown
from driftjax.learning.config import Controller
from driftjax.studies.paper.ablations import ABLATIONS

CarName = Literal["sedan", "rc"]


@dataclass(frozen=True)
class PaperConfig:
    """Every method on the same plants and noise, with ablations."""

    cars: tuple[CarName, ...] = ("sedan", "rc")
    """Cars to drive."""
    half: Literal["held_out", "development"] = "held_out"
    """Plants that no setting was chosen on, or those that settings are chosen on."""
    plants: int = 16
    """Plants in each half: numbers 0 to 15 of the distribution are for development, 16 to 31 are held out."""
    noise_seeds: int = 2
    """Noise seeds per plant."""
    seed: int = 6
    """Seed of plants and noise."""
    population: Literal["near", "wide"] = "near"
    """Distribution that the plants are drawn from, as in `learn`."""
    sensors: Literal["best", "field"] = "best"
    """Sensors at their best, or as in the field: slow errors, a bias, a delay, and a state estimator in the loop."""
    exploration_laps: int | None = None
    """Laps of exploration, as many as shipped for the car if left out."""
    main: bool = True
    """Drive the main comparison: every method."""
    ablations: bool = True
    """Also drive the ablations."""
    arms: tuple[str, ...] = ()
    """Names of the ablations to drive; all where left out."""
    ablation_plants: int = 4
    """Plants of each ablation, one noise seed."""
    ablation_controllers: tuple[Controller, ...] = ("path", "paper")
    """Controllers of the ablations."""
    quick: bool = False
    """Four plants, one noise seed, the main comparison only."""

    def __post_init__(self) -> None:
        require(len(self.cars) > 0, "key 'cars' is empty; name sedan, rc or both.")
        require_at_least(self, 1, "plants", "noise_seeds", "ablation_plants")
        require_at_least(self, 0, "seed")
        laps = self.exploration_laps
        require(laps is None or laps >= 1, f"key 'exploration_laps' is {laps}; give at least 1, or leave it out.")
        require(len(self.ablation_controllers) > 0, "key 'ablation_controllers' is empty; name path, paper or both.")
        ablated = self.ablations and not self.quick
        require(self.main or ablated, "key 'main' is false, and ablations are left out too: nothing to drive.")
        require(ablated or not self.arms, "key 'arms' names ablations, which 'quick' and 'ablations: false' leave out.")
        for name in self.arms:
            require(name in ABLATIONS, f"key 'arms' names {shown(name)}; choose among {', '.join(ABLATIONS)}.")

    @property
    def first_plant(self) -> int:
        """Return the number of the half's first plant."""
        return self.plants if self.half == "held_out" else 0

    def reduced(self) -> "PaperConfig":
        """Return the reduced configuration of `quick`."""
        return dataclasses.replace(self, noise_seeds=1, ablations=False)
