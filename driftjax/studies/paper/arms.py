"""The `driftjax learn` runs of the comparison: the main one, and one change each."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass

from driftjax.core import read_yaml
from driftjax.core.config import to_dict
from driftjax.learning.config import LearnConfig, files_of, load_learn_config
from driftjax.studies.paper.config import Car, PaperConfig

MAIN = "main"
QUICK_PLANTS = 4
GPR_BEST = "gpr-best"  # the last stage before exploration
EXTENDED = "extended"
MANY = {"num_sets": 6}  # as many candidates as laps: these do not make new ones
ABLATIONS: dict[str, tuple[str, dict]] = {
    "as_it_is": ("as in the main comparison", {}),
    EXTENDED: ("the nominal car extended by `diagnose`", {}),
    "gp_reference": ("GP in the reference only", {"layers": "reference"}),
    "gp_mpc": ("GP in the MPC only", {"layers": "mpc"}),
    "step": ("the paper's step to the equilibrium as reference", {"reference": "step"}),
    "no_lags": ("no lags: bare commands in the GP's inputs", {"gp": {"lags": False}}),
    "unbounded": ("the GP's bare mean, however far from data", {"gp": {"bounded": False}}),
    "points_50": ("dictionary of 50 points", {"gp": {"size": 50, "num_fit": 50}}),
    "points_400": ("dictionary of 400 points", {"gp": {"size": 400}}),
    "variance": ("lambda 1: variance only", {"explore": {"lam": 1.0}}),
    "nearness": ("lambda 0: nearness only", {"explore": {"lam": 0.0}}),
    "equal_P": ("P of ones", {"explore": {"P": (1.0, 1.0, 1.0)}}),
    "random": ("explored at random speeds", {"explore": MANY | {"speeds": "random"}}),
    "uniform": ("explored at evenly spaced speeds", {"explore": MANY | {"speeds": "uniform"}}),
    "planned": ("as many laps at the planned speed", {"explore": MANY | {"speeds": "planned"}}),
}  # fmt: skip
SHARED = {  # ablation: another one with the same laps up to exploration
    "variance": "as_it_is", "nearness": "as_it_is", "equal_P": "as_it_is", "uniform": "random", "planned": "random",
}  # fmt: skip


@dataclass(frozen=True)
class Arm:
    """One run of the comparison."""

    car: Car
    name: str
    words: str
    learn: LearnConfig

    @property
    def folder(self) -> str:
        """Its folder below the comparison's."""
        return f"{self.car}/{self.name}"

    @property
    def like(self) -> str | None:
        """Folder of the run with the same laps up to exploration, if any."""
        return f"{self.car}/{SHARED[self.name]}" if self.name in SHARED else None


def arms(cfg: PaperConfig) -> list[Arm]:
    """List all runs of the comparison, car by car, the main one first."""
    found = []
    for car in cfg.cars:
        base = load_learn_config(car)
        plants = min(QUICK_PLANTS, cfg.plants) if cfg.quick else cfg.plants
        main = dataclasses.replace(
            base, plants=plants, first_plant=cfg.first_plant, noise_seeds=cfg.noise_seeds, seed=cfg.seed,
            controllers=("path", "paper"), compare=True,
        )  # fmt: skip
        found.append(Arm(car, MAIN, "main comparison", main))
        small = dataclasses.replace(main, plants=min(cfg.ablation_plants, plants), noise_seeds=1, compare=False)
        found += [Arm(car, name, words, changed(small, change)) for name, (words, change) in ABLATIONS.items()
                  if cfg.ablations]  # fmt: skip
    return found


def changed(base: LearnConfig, change: dict) -> LearnConfig:
    """Return `base` with the fields in `change`, nested settings merged."""
    parts = {name: dataclasses.replace(getattr(base, name), **value) if isinstance(value, dict) else value
             for name, value in change.items()}  # fmt: skip
    return dataclasses.replace(base, **parts)


def settings_hash(arm: Arm) -> str:
    """Return the SHA-256 of the settings of a run: its options, and the content of the files that they name."""
    learn = arm.learn
    held = {kind: read_yaml(path) for kind, path in files_of(learn).items()}
    options = {key: value for key, value in to_dict(learn).items() if key not in ("plants", "first_plant", "seed")}
    return hashlib.sha256(json.dumps([options, held], sort_keys=True, default=str).encode()).hexdigest()
