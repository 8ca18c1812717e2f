"""Options of `driftjax learn`."""

import functools
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from driftjax.control.driver import SwitchConfig
from driftjax.control.mpc import MPCConfig, Weights
from driftjax.control.pursuit import PursuitConfig
from driftjax.core import find_config, from_dict, merge_config, read_yaml, require, require_at_least, require_positive
from driftjax.core.config import to_dict
from driftjax.sim import LapConfig
from driftjax.vehicle import require_steady

Controller = Literal["path", "paper"]


@dataclass(frozen=True)
class GPConfig:
    """Data and fit of the residual model."""

    size: int = 200
    """Largest number of informative points kept."""
    num_fit: int = 100
    """Points on which the marginal likelihood is maximised."""
    restarts: int = 2
    """Starts of that maximisation."""
    max_iterations: int = 25
    """Iterations of each."""
    shortest: float = 1.0
    """Shortest length scale, in standard deviations of an input: what varies faster over a lap is taken for noise."""
    kernel: Literal["se", "matern52"] = "se"
    """Kernel: squared exponential or Matern-5/2, one length scale per input."""
    lags: bool = True
    """Estimate the lags of steering and drive: the MPC knows them, the GP's inputs hold what commands reached."""
    bounded: bool = True
    """Fade the mean out far from data and bound it by twice the largest target; else the bare mean is used."""
    effects: tuple[str, ...] = ()
    """Effects of the catalogue whose parameters are fitted to the laps of each plant. The car with them is the prior
    mean of the GP, which learns what they leave and is used from the second lap of data on. Without any, the paper's
    GP on the nominal car."""
    orthogonal: bool = True
    """Extended cars only: keep the GP orthogonal to the rates that a change of the named effects' parameters causes."""

    def __post_init__(self) -> None:
        require(self.size >= 20, f"key 'size' is {self.size}; give at least 20 points.")
        require(self.num_fit >= 10, f"key 'num_fit' is {self.num_fit}; give at least 10 points.")
        require_positive(self, "shortest")
        require_steady(self.effects)
        require_at_least(self, 1, "restarts", "max_iterations")

    @property
    def program(self) -> "GPConfig":
        """Return the options that a compiled program depends on; numeric arguments are set to their defaults."""
        return replace(self, shortest=GPConfig.shortest)


@dataclass(frozen=True)
class ExploreConfig:
    """V-sets (Eq. 9) and Algorithm 1."""

    w1: float = 100.0
    """Weight on the smoothness of the speed curve."""
    w2: float = 5.0
    """Weight on following r_b e."""
    P: tuple[float, float, float] = (2.0, 1.0, 1.0)
    """Weights on the variances of dV, dbeta and dr."""
    lam: float = 0.55
    """lambda: 1 seeks variance only, 0 nearness only."""
    num_sets: int = 3
    """Number of nested bounds on gamma, so of candidate speeds."""
    laps: int = 6
    """Most laps of exploration, fewer where no entry has a candidate left; an entry without one repeats its best."""
    gamma_share: float = 0.08
    """Upper limit of the widest bound on gamma, as a share of the planned cornering speed [-]."""
    speeds: Literal["sets", "random", "uniform", "planned"] = "sets"
    """Candidates: from the V-sets; drawn at random or evenly spaced within the widest bound, nearest first; or the
    planned speed again and again. The last three are there to compare with."""
    correction: bool = True
    """Correct the path that is aimed at by the measured lateral error, by k/K of it with candidate k of K: iterative
    learning control (Arimoto, Kawamura and Miyazaki 1984). Applies to every kind of `speeds`."""
    acquisition: Literal["paper", "knowledge_gradient", "expected_improvement", "thompson", "random"] = "paper"
    """What chooses the next lap: `paper` is Algorithm 1 on the candidates of `speeds`. The others choose among a fixed
    grid of speeds, sideslips and excitations, each planned on the learnt car, by its predicted lateral error: least
    error less what the remaining laps gain by the data (`knowledge_gradient`), expected improvement, least error in one
    sample of the Gaussian process (`thompson`), or at `random`."""
    speed_range: tuple[float, float] = (-0.08, 0.04)
    """Grid: smallest and largest change of the planned speed, as a share of the cornering speed [-]."""
    num_speeds: int = 7
    """Grid: number of speeds."""
    sideslips: tuple[float, ...] = (0.8, 1.0, 1.2)
    """Grid: factors on the planned sideslip [-]."""
    dither: tuple[float, float] = (0.01, 0.02)
    """Grid: amplitude of the excitation of steering [rad] and drive [share of the weight]; zeros for none."""
    fixed_laps: bool = False
    """For comparisons: offer all `num_sets` candidates, those of equal speed too, and drive all `laps` even where no
    entry has a candidate left."""

    def __post_init__(self) -> None:
        require(self.w1 > 0 and self.w2 > 0, "keys 'w1' and 'w2' must be positive.")
        require(min(self.P) >= 0, f"key 'P' is {self.P}; no weight may be negative.")
        require(0 <= self.lam <= 1, f"key 'lam' is {self.lam}; lambda lies in 0..1.")
        require(self.num_sets >= 0, f"key 'num_sets' is {self.num_sets}; give 0 for no exploration, or more.")
        require(self.laps >= 1, f"key 'laps' is {self.laps}; give at least 1, or no sets for no exploration.")
        require(self.num_speeds >= 1, f"key 'num_speeds' is {self.num_speeds}; give at least 1.")
        require(len(self.sideslips) > 0, "key 'sideslips' is empty; give at least one factor, such as 1.")
        low, high = self.speed_range
        require(-0.5 < low <= high < 0.5, f"key 'speed_range' is {self.speed_range}; give two shares within +-0.5.")
        require(min(self.dither) >= 0, f"key 'dither' is {self.dither}; give amplitudes of 0 or more.")
        require(0 < self.gamma_share < 0.5, f"key 'gamma_share' is {self.gamma_share}; give a share below 0.5.")

    @property
    def kind(self) -> Literal["sets", "random", "uniform", "planned"]:
        """Return the kind of the speeds that Algorithm 1 chooses from: the planned one where another rule chooses."""
        return self.speeds if self.acquisition == "paper" else "planned"

    @property
    def num_laps(self) -> int:
        """Return the largest number of exploration laps; 0 without sets."""
        return self.laps if self.num_sets else 0


@dataclass(frozen=True)
class LearnConfig:
    """The paper's experiment on one car: nominal laps, GP laps, exploration, over a batch of plants."""

    car: str = "sedan"
    """Name of the car whose shipped settings are the defaults: sedan, rc, or dart, which needs --plant."""
    vehicle: Path = Path("sedan")
    """Nominal car: a shipped name or a vehicle YAML, such as the extended.yaml of a diagnosis."""
    track: Path = Path("sedan_corner")
    """Track: a shipped name, a track YAML or a CSV of x,y,w_right,w_left."""
    plan: Path = Path("sedan")
    """Options of the minimum-time planner: a shipped name or a YAML."""
    sensors: Path = Path("sedan")
    """Sensor noise: a shipped name or a YAML."""
    plants: int = 4
    """Plants drawn from the car's distribution and driven side by side."""
    estimator: bool = False
    """Drive by an extended Kalman filter on the learnt car, which also bridges the delay of the commands; else by the
    bare measurements. The delay is known to it, and to what is learnt, in any case."""
    population: Literal["near", "wide"] = "near"
    """Distribution of the drawn plants: `near` the nominal car, or `wide`, with friction biased by -5 % and spread by
    15 %, stiffness by 20 %, yaw inertia by 10 % and payload up to 10 %."""
    first_plant: int = 0
    """Number of the first plant drawn: with 16, and 16 plants, numbers 16 to 31 of the same sequence."""
    plant: tuple[Path, ...] = ()
    """Plants instead of drawn ones: shipped names, plant YAMLs, or vehicle YAMLs such as an extended.yaml."""
    noise_seeds: int = 1
    """Noise seeds per plant."""
    seed: int = 0
    """Seed of plants and noise."""
    controllers: tuple[Controller, ...] = ("path",)
    """Controllers driven side by side: `path` also tracks e and theta, `paper` is the paper's."""
    reference: Literal["entry", "step"] = "entry"
    """Reference along s: planned with its entry on the corrected car, or the paper's step to the equilibrium."""
    layers: Literal["both", "reference", "mpc", "none"] = "both"
    """Where the mean of the GP is used: in the reference and in the MPC, in one of them, or nowhere. Learnt lags,
    fitted parameters and the measured arrival are used in any case."""
    measured_arrival: bool = True
    """Plan the corner from the mean state measured where the drift controller takes over; else from the planned one."""
    excitation: tuple[float, float] = (0.0, 0.0)
    """Amplitude of a multisine added to steering [rad] and drive [share of the weight] in the nominal lap, from which
    the first GP is learnt: without it the feedback ties inputs to states, and their effects cannot be told apart."""
    gpr_laps: int = 3
    """Most GP laps; fewer where the error has converged. 0: nominal laps only, neither GP laps nor exploration."""
    converged: float = 0.05
    """Relative change of the mean lateral error below which GP laps have converged."""
    compare: bool = True
    """Also drive the other rows of the paper's table: pure pursuit, LQR, the paper's cost, single-layer GPR-MPC."""
    combined_slip: float | None = None
    """Friction ellipse of the nominal car in MPC, GP data and references: 0 is the published car, 1 a circle. The
    published car spins on plants that do not have more friction than it. Left out: 1, but an extended car keeps the
    one that its effects were found with."""
    drift_beta: float = 0.436332
    """Sideslip of the drift equilibrium that is aimed at, magnitude [rad]."""
    mpc: MPCConfig = field(default_factory=MPCConfig)
    path: Weights = Weights((5.0, 200.0, 20.0), (30.0, 200.0), 1000.0)
    paper: Weights = Weights()
    lqr_price: float = 1000.0
    """Weight on input changes in the LQR over that in the MPC: the LQR knows no limits."""
    entry_error: float = 10.0
    """Weight on the lateral error where the corner is planned on the corrected car, over that in the MPC: where path
    and speed cannot both be kept, the plan changes the speed."""
    switch: SwitchConfig = SwitchConfig(lead=15.0, trail=6.0)
    pursuit: PursuitConfig = field(default_factory=PursuitConfig)
    lap: LapConfig = field(default_factory=LapConfig)
    gp: GPConfig = field(default_factory=GPConfig)
    explore: ExploreConfig = field(default_factory=ExploreConfig)

    @property
    def distribution(self) -> str:
        """Return the name of the distribution that plants are drawn from."""
        return self.car if self.population == "near" else f"{self.car}_{self.population}"

    @property
    def nothing_learnt(self) -> "LearnConfig":
        """Return these options for laps that nothing is learnt from: no parameter of the car is free."""
        return replace(self, gp=replace(self.gp, effects=()))

    @property
    def batch_size(self) -> int:
        """Return the number of laps driven side by side."""
        return (len(self.plant) or self.plants) * self.noise_seeds * len(self.controllers)

    def __post_init__(self) -> None:
        require_at_least(self, 1, "plants", "noise_seeds")
        require_at_least(self, 0, "first_plant", "seed", "gpr_laps")
        require(min(self.excitation) >= 0, f"key 'excitation' is {self.excitation}; give amplitudes of 0 or more.")
        require(len(self.controllers) > 0, "key 'controllers' is empty; name path, paper or both.")
        require_at_least(self, 0, "converged")
        require_positive(self, "entry_error")
        require(0 < self.drift_beta < 1.2, f"key 'drift_beta' is {self.drift_beta}; give radians between 0 and 1.2.")


def load_learn_config(name: str | Path) -> LearnConfig:
    """Load options of `learn`: a shipped name (`sedan`, `rc`, `dart`), or a YAML of what differs from its car's.

    A YAML names its car by the key `car`; without it the car is the sedan.
    """
    path = find_config("learn", name)
    return complete_learn_config(read_yaml(path), str(path))


def complete_learn_config(options: dict[str, Any], where: str) -> LearnConfig:
    """Complete `options` of `learn` by the shipped ones of the car that they name; `where` names them in errors."""
    return from_dict(LearnConfig, merge_config(to_dict(_shipped(str(options.get("car", "sedan")))), options), where)


@functools.cache  # a sweep asks for the same ones at every trial
def _shipped(car: str) -> LearnConfig:
    path = find_config("learn", car)
    return from_dict(LearnConfig, read_yaml(path), str(path))


def files_of(config: LearnConfig) -> dict[str, Path]:
    """Return the files that the options name, and those that these name: CSV of a track, tyre file, base of a plant.

    The distribution of the car's plants is among them unless plants are given.
    """
    named = {"vehicle": config.vehicle, "track": config.track, "plan": config.plan, "sensors": config.sensors}
    files = {kind: find_config(kind, name) for kind, name in named.items()}
    given = {f"plant.{i}": name for i, name in enumerate(config.plant)} or {
        "plant": f"{config.distribution}_distribution"
    }
    files |= {key: find_config("plant", name) for key, name in given.items()}
    return {f"{kind}, {path.name}" if i else kind: path
            for kind, first in files.items() for i, path in enumerate(_with_named(first))}  # fmt: skip


def is_yaml(path: Path) -> bool:
    """Return whether the name of a file says that it is YAML."""
    return path.suffix.lower() in (".yaml", ".yml")


def _with_named(path: Path) -> list[Path]:
    """Return a file and, of a YAML, the files that its keys name."""
    if not is_yaml(path):
        return [path]
    values = read_yaml(path)
    inner = values["nominal"] if isinstance(values.get("nominal"), dict) else {}
    named = [path.parent / name for name in (values.get("path"), values.get("tyre"), inner.get("tyre")) if name]
    base = [find_config("plant", path.parent / f"{values['base']}.yaml")] if values.get("base") else []
    return [path, *(one for below in (*named, *base) for one in _with_named(below))]
