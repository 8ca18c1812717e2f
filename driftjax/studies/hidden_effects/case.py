"""One case of the study: the hidden effects, the car and the measurement; one JSON line repeats it."""

import json
from dataclasses import dataclass
from typing import Literal

import numpy as np

from driftjax.core import BadInput, from_dict, require
from driftjax.core.config import to_dict
from driftjax.manoeuvres.library import RICH
from driftjax.vehicle.effect import EFFECTS, Effect

CaseKind = Literal["none", "single", "pair", "absent", "poor", "foreign"]
FOREIGN = ("std", "mb")  # cars that another simulator drives
POOR = ("steady_drift",) * 3  # runs with little excitation


@dataclass(frozen=True)
class Hidden:
    """One hidden effect."""

    name: str
    """Of the catalogue."""
    strengths: tuple[float, ...]
    """Its parameters, in typical sizes."""

    def __post_init__(self) -> None:
        require(self.name in EFFECTS, f"effect '{self.name}': no such effect; see driftjax/vehicle/effect.")
        num = len(EFFECTS[self.name].parameters)
        require(len(self.strengths) == num, f"effect '{self.name}' has {num} parameters; give as many strengths.")


@dataclass(frozen=True)
class Case:
    """One measurement with its hidden truth."""

    condition: CaseKind
    """No effect, one, two, one missing from the catalogue, one in a log with little excitation (the proposed manoeuvre
    is then driven too), or a foreign simulator."""
    car: str
    """A shipped car, or the simulator std or mb."""
    seed: int
    """Of manoeuvres, noise and the diagnosis."""
    effects: tuple[Hidden, ...] = ()
    """Effects of the measured car that the nominal one lacks."""
    scale: float = 1.0
    """Factor that strengths were drawn with [-]."""
    process_noise: float = 1.0
    """Disturbance of the car's motion; 1 is typical [-]."""
    noise: float = 1.0
    """Sensor noise; 1 is typical [-]."""
    manoeuvres: tuple[str, ...] = RICH
    """One run each."""
    without: tuple[str, ...] = ()
    """Effects removed from the catalogue."""

    def __post_init__(self) -> None:
        require((self.condition == "foreign") == (self.car in FOREIGN), f"a {self.condition} case has no {self.car}.")

    @property
    def group(self) -> str:
        """Return the group in which the case is counted."""
        words = [self.condition, self.car]
        words += [f"x{self.scale:g}"] if self.scale != 1 else []
        words += ["quiet"] if self.process_noise == 0 else []
        words += [f"noise x{self.noise:g}"] if self.noise != 1 else []
        return " ".join(words)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the hidden effects."""
        return tuple(one.name for one in self.effects)

    def line(self) -> str:
        """Return the case as one line of JSON."""
        return json.dumps(to_dict(self))

    def theta(self, effects: tuple[Effect, ...]) -> np.ndarray:
        """Return the truth in typical sizes, for the parameters of the catalogue `effects`."""
        strengths = {one.name: one.strengths for one in self.effects}
        each = [strengths.get(e.name, (0.0,) * len(e.parameters)) for e in effects]
        return np.array([value for values in each for value in values])


def read_case(line: str) -> Case:
    """Read the case of a JSON line."""
    try:
        values = json.loads(line)
    except json.JSONDecodeError as error:
        raise BadInput(f"case: not JSON ({error}); give a line as the bench prints it.") from None
    return from_dict(Case, values, "case")


def draw_hidden(name: str, scale: float, rng: np.random.Generator) -> Hidden:
    """Draw an effect of random strength and, where allowed, random sign."""
    strengths = []
    for parameter in EFFECTS[name].parameters:
        sign = rng.choice([-1.0, 1.0]) if parameter.lower < 0 else 1.0
        size = scale * rng.uniform(0.5, 1.5) * sign
        strengths.append(round(float(np.clip(size, parameter.lower, parameter.upper)), 4))
    return Hidden(name, tuple(strengths))


def draw_names(num: int, choice: tuple[str, ...], rng: np.random.Generator) -> list[str]:
    """Draw `num` of `choice` in random order, each equally often."""
    names: list[str] = []
    while len(names) < num:
        names += [choice[i] for i in rng.permutation(len(choice))]
    return names[:num]
