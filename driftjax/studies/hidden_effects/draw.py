"""Draw the cases of a bench, in an order in which every prefix is a fair sample."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from driftjax.core import require
from driftjax.manoeuvres.library import RICH
from driftjax.studies.hidden_effects.case import POOR, Case, Hidden, draw_hidden, draw_names
from driftjax.vehicle.effect import default_catalogue


@dataclass(frozen=True)
class CaseNumbers:
    """How many cases of each condition."""

    none: int = 100
    """Nothing hidden, process noise on."""
    none_noise: int = 40
    """Nothing hidden, sensor noise half and twice the typical."""
    quiet: int = 100
    """One effect, measurement noise only."""
    single: int = 100
    """One effect, process noise on."""
    weak: int = 50
    """One effect at 0.3 of its typical size."""
    pair: int = 60
    """Two effects."""
    absent: int = 60
    """One effect that is taken out of the catalogue."""
    poor: int = 40
    """One effect in steady drifts only; the manoeuvre that the diagnosis proposes is driven, and it is made again."""
    std: int = 2
    """Drives of CommonRoad's drift model."""
    mb: int = 2
    """Drives of CommonRoad's multi-body model."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(value >= 0, f"key '{name}' is {value}; give 0 or more cases.")


DEFAULT = tuple(effect.name for effect in default_catalogue())
WEAK = 0.3  # of the typical size


def draw_cases(
    numbers: CaseNumbers, cars: tuple[str, ...], seed: int, choice: tuple[str, ...] = DEFAULT,
    manoeuvres: tuple[str, ...] = RICH,
) -> list[Case]:  # fmt: skip
    """Draw all cases of `seed`, with effects from `choice`."""
    rng = np.random.default_rng(seed)
    cases: list[Case] = []
    for car in cars:
        cases += [Case("none", car, 0) for _ in range(numbers.none)]
        cases += [Case("none", car, 0, noise=(0.5, 2.0)[i % 2]) for i in range(numbers.none_noise)]
        of = lambda num: draw_names(num, choice, rng)
        one = lambda name, scale=1.0: (draw_hidden(name, scale, rng),)
        cases += [Case("single", car, 0, one(n), process_noise=0.0) for n in of(numbers.quiet)]  # noqa: B023
        cases += [Case("single", car, 0, one(n)) for n in of(numbers.single)]
        cases += [Case("single", car, 0, one(n, WEAK), WEAK) for n in of(numbers.weak)]
        cases += [Case("pair", car, 0, _two(choice, rng)) for _ in range(numbers.pair)]
        cases += [Case("absent", car, 0, one(n), without=(n,)) for n in of(numbers.absent)]
        cases += [Case("poor", car, 0, one(n), manoeuvres=POOR) for n in of(numbers.poor)]
    cases += [Case("foreign", car, 0) for car, num in (("std", numbers.std), ("mb", numbers.mb)) for _ in range(num)]
    order = [cases[i] for i in rng.permutation(len(cases))]
    order = [dataclasses.replace(case, seed=int(rng.integers(2**32))) for case in order]
    return [case if case.condition == "poor" else dataclasses.replace(case, manoeuvres=manoeuvres) for case in order]


def _two(choice: tuple[str, ...], rng: np.random.Generator) -> tuple[Hidden, ...]:
    first, second = rng.choice(len(choice), 2, replace=False)
    return draw_hidden(choice[first], 1.0, rng), draw_hidden(choice[second], 1.0, rng)
