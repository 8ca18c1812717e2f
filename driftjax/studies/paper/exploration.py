"""Compare what chooses the exploration laps: error of the best lap so far against the number of laps."""

from typing import Any

import numpy as np

from driftjax.learning.metrics import interval, reduction
from driftjax.store import RunFolder

CHOOSERS = {  # ablations that differ only in what chooses the laps, and their names in figures
    "knowledge_gradient": "knowledge gradient",
    "expected_improvement": "expected improvement",
    "thompson": "Thompson sampling",
    "random_grid": "random, of the grid",
    "as_it_is": "Algorithm 1 on V-sets",
    "random": "random, as wide as V-sets",
    "uniform": "evenly spaced",
    "planned": "planned speed",
}
OURS = "knowledge_gradient"


def best_so_far(run: RunFolder, controller: str) -> np.ndarray:
    """Return the true lateral error [m] of the lap with the least measured one so far, (1 + laps, plants).

    The first row is the best GP lap, before exploration; a lap that was not completed is never the best. Means over
    noise seeds.
    """
    stages = [name for name in run.finished() if name.startswith(("gpr-", "explore-")) and not name.endswith("-best")]
    data = [run.read_stage(name) for name in stages]
    lanes = np.flatnonzero(data[0]["controller"].values == controller)
    column = lambda name: np.array([one[name].values[lanes] for one in data], float)
    measured = np.where(column("completed") > 0, column("lateral_error_measured"), np.inf)
    before = sum(name.startswith("gpr-") for name in stages)
    true, rows = column("lateral_error"), []
    for num in range(before, len(stages) + 1):
        best = np.argmin(measured[:num], axis=0)
        rows.append(np.take_along_axis(true[:num], best[None], axis=0)[0])
    plants = data[0]["plant"].values[lanes]
    return np.array([[row[plants == name].mean() for name in dict.fromkeys(plants.tolist())] for row in rows])


def compare_choosers(ablations: dict[str, Any]) -> dict[str, Any]:
    """Return per controller the curves of the finished `ablations` in `CHOOSERS` and the contrasts between them.

    `regret` is to the lap that was best of all rules on the same plant after all laps. `against` has the reduction
    of the error by the knowledge gradient in percent, paired over plants, after every lap, with 95 % intervals by
    Student's t; `best_rival` names the rule with the least mean error after as many laps.
    """
    laps: dict[str, dict[str, np.ndarray]] = {}
    for name in CHOOSERS:
        for who, errors in ablations.get(name, {}).get("best_so_far", {}).items():
            laps.setdefault(who, {})[name] = np.asarray(errors, float)
    return {who: _compare(errors) for who, errors in laps.items() if len(errors) > 1}


def _compare(laps: dict[str, np.ndarray]) -> dict[str, Any]:
    """Compare rules by their errors (1 + laps, plants), as far as all of them have laps."""
    num = min(map(len, laps.values()))
    laps = {name: errors[:num] for name, errors in laps.items()}
    best = np.min([errors[-1] for errors in laps.values()], axis=0)
    curves = {
        name: {
            "error": [interval(row) | {"per_plant": row.tolist()} for row in errors],
            "regret": [interval(row - best) for row in errors],
        }
        for name, errors in laps.items()
    }
    if OURS not in laps:
        return {"curves": curves}
    rivals = {name: errors for name, errors in laps.items() if name != OURS}
    against = {name: [reduction(errors[k], laps[OURS][k]) for k in range(num)] for name, errors in rivals.items()}
    least = [min(rivals, key=lambda name, k=k: float(rivals[name][k].mean())) for k in range(num)]
    return {"curves": curves, "against": against, "best_rival": least}
