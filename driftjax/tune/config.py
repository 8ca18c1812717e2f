"""Options of `driftjax tune`."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from driftjax.core import from_dict, require, require_at_least, shown
from driftjax.core.config import to_dict
from driftjax.learning.config import LearnConfig, complete_learn_config
from driftjax.tune.parameters import NAMES

QUICK = {"training": 1, "held_out": 2, "budget": 12}  # shows that it runs, and measures nothing


@dataclass(frozen=True)
class Scales:
    """Scales of the errors in the loss."""

    e: float = 0.5
    """Lateral error against the planned path [m]."""
    beta: float = 0.2
    """Sideslip less the planned one [rad]."""
    change: float = 0.5
    """Change of the steering command per step [rad]."""
    failed: float = 10.0
    """Loss of a lap that is not completed [-]."""

    def __post_init__(self) -> None:
        held = (self.e, self.beta, self.change, self.failed)
        require(min(held) > 0, f"keys 'e', 'beta', 'change' and 'failed' hold {held}; all must be positive.")


@dataclass(frozen=True)
class TuneConfig:
    """Q, R and switching lead of the path-tracking drift MPC, tuned on some plants and evaluated on others."""

    training: int = 4
    """Plants to tune on, drawn as `driftjax learn` draws them."""
    held_out: int = 8
    """Plants for evaluation, drawn after those and never tuned on."""
    budget: int = 23
    """Laps per training plant that tuning may take, and random search too; a gradient counts as 7."""
    weights: float = 4.0
    """Box of both searches: each weight within this factor of where it starts [-]."""
    lead: float = 2.0
    """Box of both searches: the switching lead within this factor of where it starts [-]."""
    blend: float = 3.0
    """Distance over which the switch is smooth in laps that are differentiated; evaluated laps switch at once [m]."""
    scales: Scales = field(default_factory=Scales)
    learn: LearnConfig = field(default_factory=LearnConfig)
    """Car, track and controller as in `driftjax learn`: nominal laps; options of learning have no effect."""

    def __post_init__(self) -> None:
        require_at_least(self, 1, "training")
        require_at_least(self, 2, "held_out", "budget")
        require(self.weights > 1, f"key 'weights' is {self.weights}; give a factor above 1.")
        require(self.lead > 1, f"key 'lead' is {self.lead}; give a factor above 1.")
        require(self.blend > 0, f"key 'blend' is {self.blend}; give a length in metres above 0.")
        require(not self.learn.estimator, "key 'estimator': the blended switch of `tune` needs bare measurements.")
        require(not self.learn.plant, "key 'plant' names plants; those of `tune` are drawn.")
        held = (*self.learn.path.Q, self.learn.switch.lead)
        require(min(held) > 0, f"keys 'Q' and 'lead' hold {held}; what is 0 cannot be tuned by factors.")

    @property
    def box(self) -> Float[np.ndarray, " 6"]:
        """Return the largest magnitude of each parameter, a logarithm of a factor [-]."""
        return np.log([self.lead if name == "lead" else self.weights for name in NAMES])


def complete_tune_config(options: dict[str, Any], where: str, car: str | None = None) -> TuneConfig:
    """Complete `options` of `tune` by the shipped ones of `car`, else of the car that they name; `where` names them."""
    learn = options.get("learn") or {}
    require(isinstance(learn, dict), f"{where}: key 'learn' is {shown(learn)}; it needs keys of its own.")
    completed = complete_learn_config(learn | ({"car": car} if car else {}), f"{where}: key 'learn'")
    return from_dict(TuneConfig, options | {"learn": to_dict(completed)}, where)
