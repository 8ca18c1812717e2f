"""The `driftjax learn` runs of the comparison: the main one, and one change each."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from driftjax.core import read_yaml
from driftjax.core.config import to_dict
from driftjax.learning.config import ExploreConfig, LearnConfig, files_of, is_yaml, load_learn_config
from driftjax.studies.paper.ablations import ABLATIONS
from driftjax.studies.paper.config import CarName, PaperConfig

MAIN = "main"
QUICK_PLANTS = 4
GPR_BEST = "gpr-best"  # the last stage before exploration
EXTENDED = "extended"


@dataclass(frozen=True)
class Arm:
    """One run of the comparison."""

    car: CarName
    name: str
    words: str
    learn: LearnConfig
    like: str | None = None
    """Folder of the run with the same laps up to exploration, if any."""

    @property
    def folder(self) -> str:
        """Return its folder below that of the comparison."""
        return f"{self.car}/{self.name}"


def arms(cfg: PaperConfig) -> list[Arm]:
    """List all runs of the comparison, car by car, the main one first.

    Ablations drive all their GP laps and all their exploration laps, so that they differ in the one change only.
    """
    listed: list[Arm] = []
    for car in cfg.cars:
        base = _with_options(load_learn_config(car), cfg)
        plants = min(QUICK_PLANTS, cfg.plants) if cfg.quick else cfg.plants
        main = dataclasses.replace(
            base, plants=plants, first_plant=cfg.first_plant, noise_seeds=cfg.noise_seeds, seed=cfg.seed,
            controllers=("path", "paper"), compare=True,
        )  # fmt: skip
        listed += [Arm(car, MAIN, "main comparison", main)] if cfg.main else []
        small = dataclasses.replace(
            main, plants=min(cfg.ablation_plants, plants), noise_seeds=1, compare=False, converged=0.0,
            controllers=cfg.ablation_controllers, explore=dataclasses.replace(main.explore, fixed_laps=True),
        )  # fmt: skip
        for name in [name for name in ABLATIONS if cfg.ablations and name in (cfg.arms or ABLATIONS)]:
            words, change = ABLATIONS[name]
            arm = Arm(car, name, words, changed(small, change))
            listed.append(dataclasses.replace(arm, like=first_alike(arm, listed)))
    return listed


def _with_options(base: LearnConfig, cfg: PaperConfig) -> LearnConfig:
    """Return the options of a car with population, sensors and laps of the comparison."""
    if cfg.sensors == "field":
        base = dataclasses.replace(base, sensors=Path(f"{base.sensors}_field"), estimator=True)
    if cfg.exploration_laps is not None:
        base = dataclasses.replace(base, explore=dataclasses.replace(base.explore, laps=cfg.exploration_laps))
    return dataclasses.replace(base, population=cfg.population)


def first_alike(arm: Arm, before: list[Arm]) -> str | None:
    """Return the folder of the first run in `before` with the same laps up to exploration as `arm`, if any."""
    if arm.name == EXTENDED:  # its car is found when it is driven
        return None
    alike = (other.folder for other in before if other.name != EXTENDED and unexplored(other) == unexplored(arm))
    return next(alike, None)


def unexplored(arm: Arm) -> LearnConfig:
    """Return the options that the laps before exploration, and the shapes of their state, depend on."""
    return dataclasses.replace(arm.learn, explore=ExploreConfig(num_sets=arm.learn.explore.num_sets))


def changed(base: LearnConfig, change: dict) -> LearnConfig:
    """Return `base` with the fields in `change`, nested settings merged."""
    parts = {name: dataclasses.replace(getattr(base, name), **value) if isinstance(value, dict) else value
             for name, value in change.items()}  # fmt: skip
    return dataclasses.replace(base, **parts)


def settings_hash(arm: Arm) -> str:
    """Return the SHA-256 of the settings of a run: its options, and the content of the files that they name."""
    learn = arm.learn
    held = {kind: read_yaml(path) if is_yaml(path) else hashlib.sha256(path.read_bytes()).hexdigest()
            for kind, path in files_of(learn).items()}  # fmt: skip
    options = {key: value for key, value in to_dict(learn).items() if key not in ("plants", "first_plant", "seed")}
    return hashlib.sha256(json.dumps([options, held], sort_keys=True, default=str).encode()).hexdigest()
