"""Configuration of a sweep: fields of a verb's options, a design over them, and the objective."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from driftjax.core import BadInput, from_dict, read_yaml, require, require_at_least, shown

Value = bool | int | float | str | None
DesignPoint = dict[str, Value]  # a combination of values


@dataclass(frozen=True)
class Range:
    """Numbers between two bounds."""

    low: float
    high: float
    log: bool = False
    """Evenly spread in the logarithm."""
    integer: bool = False
    """Whole numbers only, both bounds included."""

    def __post_init__(self) -> None:
        require(all(map(math.isfinite, (self.low, self.high))), "keys 'low' and 'high' must be finite numbers.")
        require(self.low < self.high, f"key 'low' is {self.low}, 'high' {self.high}; it must be below it.")
        require(self.low > 0 or not self.log, f"key 'low' is {self.low}; with 'log' it must be positive.")
        integers = self.low.is_integer() and self.high.is_integer()
        require(integers or not self.integer, "keys 'low' and 'high' must be whole numbers with 'integer'.")

    def value_at(self, u: float) -> float | int:
        """Return the value at the fraction `u` in [0, 1) of the range."""
        low, high = (self.low, self.high + 1) if self.integer else (self.low, self.high)
        value = low * (high / low) ** u if self.log else low + (high - low) * u
        return min(math.floor(value), int(self.high)) if self.integer else value


@dataclass(frozen=True)
class Choices:
    """One value of a list."""

    values: tuple[Value, ...]

    def __post_init__(self) -> None:
        require(len(self.values) > 0, "the list of values is empty; give at least one.")
        plain = all(isinstance(value, bool | int | float | str | None) for value in self.values)
        require(plain, f"the values {list(self.values)} must be numbers, words, true or false.")

    def value_at(self, u: float) -> Value:
        """Return the value at the fraction `u` in [0, 1) of the list."""
        return self.values[min(int(u * len(self.values)), len(self.values) - 1)]


Field = Range | Choices


@dataclass(frozen=True)
class SweepConfig:
    """A sweep: the verb, its options, the fields varied, and how."""

    fields: dict[str, Any]
    """Fields varied, `gp.size` or `path.Q.0`: a list of values, or {low, high, log, integer}."""
    verb: Literal["learn", "diagnose", "paper"] = "learn"
    """What each trial runs."""
    base: dict[str, Any] = field(default_factory=dict)
    """Options of the verb where they differ from its defaults; `logs` for diagnose."""
    design: Literal["grid", "random", "lhs", "optuna"] = "grid"
    """All combinations of lists; drawn at random; Latin hypercube; or chosen by Optuna as results come in."""
    num: int = 32
    """Trials of a design that is no grid."""
    seed: int = 0
    """Seed of the design; the seed of a trial's own noise is an option of the verb."""
    objective: str = "lateral_error"
    """Figure to minimise; its mean over a trial's rows counts."""
    second: str = "lap_time"
    """Second figure to minimise, for the Pareto front."""
    stage: str = ""
    """Stage of `learn` that is evaluated; the trial's last if omitted."""
    sampler: str = "TPESampler"
    """Optuna: name of the sampler in optuna.samplers."""
    pruner: str = "NopPruner"
    """Optuna: name of the pruner in optuna.pruners; stages of `learn` are its steps."""
    storage: str = ""
    """Optuna: URL of a database of your own; a file in the sweep's folder where left out."""

    def __post_init__(self) -> None:
        require(len(self.fields) > 0, "key 'fields' is empty; name at least one field with its values.")
        require_at_least(self, 1, "num")
        require_at_least(self, 0, "seed")
        for name, values in self.varied.items():
            lists = isinstance(values, Choices)
            require(lists or self.design != "grid", f"key 'fields.{name}': a grid needs a list of values.")

    @property
    def varied(self) -> dict[str, Field]:
        """Return the fields with their values."""
        return {name: _field(value, f"key 'fields.{name}'") for name, value in self.fields.items()}


def _field(value: Any, where: str) -> Field:
    if isinstance(value, list | tuple):
        numbers = {type(item) for item in value} == {int, float}
        try:
            return Choices(tuple(map(float, value)) if numbers else tuple(value))
        except BadInput as error:
            raise BadInput(f"{where}: {error}") from None
    if isinstance(value, dict):
        return from_dict(Range, value, where)
    raise BadInput(f"{where} is {shown(value)}; give a list of values, or low and high.")


def load_sweep(path: Path) -> SweepConfig:
    """Read a sweep YAML; raises `BadInput` that names file and key."""
    return from_dict(SweepConfig, read_yaml(path), str(path))
