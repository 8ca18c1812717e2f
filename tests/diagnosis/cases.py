"""What tests of the diagnosis hide in which car, and how it is recorded and diagnosed."""

from typing import NamedTuple

import numpy as np
from diagnosis.recorded import EFFECTS, nominal_car, recorded

from driftjax.logs import Run
from driftjax.studies.hidden_effects import criteria
from driftjax.studies.hidden_effects.case import Case, Hidden
from driftjax.studies.hidden_effects.foreign_simulator import foreign_runs, foreign_vehicle
from driftjax.studies.hidden_effects.trial import diagnose_case


class Fixed(NamedTuple):
    """A case chosen in advance; its number is the seed of manoeuvres, noise and diagnosis."""

    number: int
    car: str
    truth: dict[str, float] = {}  # effects in typical sizes  # noqa: RUF012
    without: tuple[str, ...] = ()  # effects that the catalogue lacks

    def case(self) -> Case:
        """The same as a case of the bench."""
        effects = tuple(Hidden(name, (size,)) for name, size in self.truth.items())
        kind = "absent" if self.without else ("none", "single", "pair")[len(effects)]
        return Case(kind, self.car, self.number, effects, without=self.without)

    def runs(self) -> tuple[Run, ...]:
        """Six runs of 6 s, less those in which the car spins."""
        return recorded(self.case().theta(EFFECTS), self.number, self.number, car=self.car)

    def result(self, held_out: int = 0) -> criteria.Result:
        """What the diagnosis makes of it; its gain is measured on every `held_out`-th run."""
        return diagnose_runs(self.case(), self.runs(), held_out)


def diagnose_runs(case: Case, runs: tuple[Run, ...], held_out: int = 0) -> criteria.Result:
    """What the diagnosis with the small catalogue makes of `runs`."""
    return diagnose_case(case, nominal_car(case.car), runs, EFFECTS, held_out)


def foreign(number: int, car: str = "std", runs: int = 4) -> criteria.Result:
    """The same of a drive of CommonRoad's model `car`."""
    case = Case("foreign", car, number)
    return diagnose_case(case, foreign_vehicle(), foreign_runs(car, number, 1.0, runs), EFFECTS, 0)


def runs_without_spin(case: Case, attempts: int = 10) -> tuple[Run, ...]:
    """The runs of a drawn `case`, drawn again from its seed until the car spins in none."""
    rng = np.random.default_rng(case.seed)
    for _ in range(attempts):
        runs = recorded(case.theta(EFFECTS), *map(int, rng.integers(2**31, size=2)), car=case.car)
        if len(runs) == len(case.manoeuvres):
            return runs
    raise AssertionError(f"the car spins in every recording of {case.line()}")
