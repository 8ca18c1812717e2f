"""Find the units that no column name states: those with which the channels agree best."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from driftjax.logs.guess.names import DIMENSIONS, Meaning
from driftjax.logs.guess.relations import FACTORS, Signal, Values, fit_relation, kinematic_relations, turned

SHARE_UNIT = (("V", "vx", "vy"), ("r",), ("psi",), ("beta",), ("ax", "ay"))  # channels that have one unit in a log
CLEAR = 0.8  # correlation from which the sizes must agree
COST = 0.05  # of a unit that is not the first of its dimension, in natural logarithms of a factor
WORST = 1.5  # of one relation
LIMITS = {"V": 120.0, "r": 12.0, "beta": 3.2, "ax": 60.0, "ay": 60.0}  # beyond which a channel is implausible [SI]
SAMPLES = 1200  # that are compared


def best_factors(signals: dict[str, Signal], meanings: dict[str, Meaning], factors: dict[str, float], dt: float,
                 ) -> dict[str, float]:  # fmt: skip
    """Return a factor without sign for every channel whose column states no unit.

    `signals` are the columns in their units, `factors` what they are multiplied by so far.
    """
    free = [[role for role in family if role in signals and meanings[role].unit is None] for family in SHARE_UNIT]
    free = [family for family in free if family]
    if not free:
        return {}
    every = max(len(next(iter(signals.values())).y) // SAMPLES, 1)
    thin = {role: Signal(one.y[::every], one.rate[::every]) for role, one in signals.items()}
    best, best_sizes = np.inf, dict[str, float]()
    for chosen in product(*(FACTORS[DIMENSIONS[family[0]]] for family in free)):
        sizes = {role: factor for family, factor in zip(free, chosen, strict=True) for role in family}
        scale = lambda role, sizes=sizes: float(np.copysign(sizes.get(role, factors[role]), factors[role]))
        v = turned({role: one.scaled(scale(role)) for role, one in thin.items()})
        cost = sum(_costs(v, every * dt))
        cost += COST * sum(
            factor != FACTORS[DIMENSIONS[family[0]]][0] for family, factor in zip(free, chosen, strict=True)
        )
        if cost < best:
            best, best_sizes = cost, sizes
    return best_sizes


def _costs(v: Values, dt: float) -> Iterator[float]:
    """Yield for each channel how much it contradicts the others or exceeds its plausible range."""
    for role, signal in v.items():
        if role in LIMITS and np.nanpercentile(np.abs(signal.y), 98) > LIMITS[role]:
            yield WORST
        everywhere = np.ones(len(signal.y), bool)
        for rule in kinematic_relations(role, v, dt):
            fit = None if rule.scale_free else fit_relation(rule, signal, everywhere)
            if fit is not None and abs(fit.correlation) > CLEAR:
                yield rule.strength * min(abs(float(np.log(abs(fit.factor)))), WORST)
