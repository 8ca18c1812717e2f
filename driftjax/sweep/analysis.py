"""Analysis of a sweep: trials in order, sensitivity to each field, Pareto front."""

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import duckdb
import numpy as np

from driftjax.report.table import cell
from driftjax.sweep.config import Choices, Field, SweepConfig
from driftjax.sweep.store import Store

ENOUGH = 24  # trials from which shares of the variance are computed
BINS, CELL = 8, 6  # groups of a field's values; trials that a pair of groups should hold
RESAMPLES = 400

Shares = dict[str, tuple[float, float, float]]  # of a field or pair: share of the variance, its interval


@dataclass(frozen=True)
class Analysis:
    """Finished trials with an objective, best first."""

    config: SweepConfig
    ids: list[str]
    values: dict[str, np.ndarray]  # of each field, places in the list for words
    objective: np.ndarray
    second: np.ndarray  # NaN where a trial has none
    status: dict[str, int]  # trials by how they ended
    num_without: int  # done, but without an objective

    @property
    def labels(self) -> dict[str, list[str]]:
        """Return the labels of a field's values 0, 1, ... where they are no numbers."""
        words = {name: _words(values) for name, values in self.config.varied.items()}
        return {name: list(map(str, options)) for name, options in words.items() if options}

    @property
    def front(self) -> np.ndarray:
        """Return the indices of the trials that no other beats in both figures."""
        both = np.flatnonzero(np.isfinite(self.second))
        least, best = np.inf, []
        for i in both[np.lexsort((self.second[both], self.objective[both]))]:
            if self.second[i] < least:
                least = self.second[i]
                best.append(i)
        return np.array(best, int)


def _words(values: Field) -> tuple:
    """Return the values of a list that are not numbers, in order; empty if all are numbers."""
    if not isinstance(values, Choices):
        return ()
    return () if {type(value) for value in values.values} <= {int, float} else values.values


def analyse(store: Store, config: SweepConfig) -> Analysis:
    """Read all trials of the store; a figure is the mean over the rows of the stage, missing where a row has none."""
    files = [str(path) for path in store.parts()]
    fields = list(config.varied)
    rows: list[tuple] = []
    status: dict[str, int] = {}
    if files:
        database = duckdb.connect()
        database.register("rows", database.read_parquet(files))  # pyright: ignore[reportArgumentType]
        status = dict(database.sql("select status, count(distinct trial) from rows group by status").fetchall())
        rows = database.execute(_query(store, config, fields), [config.stage] if config.stage else []).fetchall()
    kept = [row for row in rows if row[1] is not None]
    columns = list(zip(*kept, strict=True)) or [()] * (3 + len(fields))
    values = {name: _numbers(config.varied[name], column) for name, column in zip(fields, columns[3:], strict=True)}
    second = np.array([np.nan if value is None else value for value in columns[2]], float)
    return Analysis(
        config, list(columns[0]), values, np.array(columns[1], float), second, status, len(rows) - len(kept)
    )


def _query(store: Store, config: SweepConfig, fields: list[str]) -> str:
    def mean(name: str) -> str:
        return f'case when count("{name}") = count(*) then avg("{name}") end' if name in store.schema.names else "null"

    chosen = "stage = ?" if config.stage else "step = (select max(step) from rows other where other.trial = rows.trial)"
    picked = "".join(f', any_value("{name}")' for name in fields)
    return (
        f"select trial, {mean(config.objective)} as objective, {mean(config.second)}{picked} from rows "
        f"where status = 'done' and {chosen} group by trial order by objective nulls last, trial"
    )


def _numbers(values: Field, column: tuple) -> np.ndarray:
    words = _words(values)
    return np.array([words.index(value) if words else value for value in column], float)


def groups_of(values: np.ndarray, num: int = BINS) -> np.ndarray:
    """Return the group of each value: one per level where there are few levels, else quantiles."""
    levels = np.unique(values)
    if len(levels) <= num:
        return np.searchsorted(levels, values)
    return np.searchsorted(np.quantile(values, np.linspace(0, 1, num + 1)[1:-1]), values, side="right")


def explained_share(y: np.ndarray, group: np.ndarray) -> float:
    """Return the share of the variance of `y` between groups, less chance (epsilon squared, Kelley 1935)."""
    sizes = np.bincount(group)
    held = sizes > 0
    means = np.bincount(group, y)[held] / sizes[held]
    within = np.sum((y - (np.bincount(group, y) / np.maximum(sizes, 1))[group]) ** 2)
    between, free = np.sum(sizes[held] * (means - y.mean()) ** 2), len(y) - held.sum()
    if free < 1:
        return float("nan")
    return float((between - (held.sum() - 1) * within / free) / (between + within))


def sensitivity(analysis: Analysis) -> Shares | None:
    """Compute the share of the variance that each field explains by itself (its first-order index), and each pair
    beyond its two, with a 95 % bootstrap interval over trials; None of too few trials or of equal ones."""
    groups = {name: groups_of(values) for name, values in analysis.values.items() if len(np.unique(values)) > 1}
    y = analysis.objective
    if len(y) < ENOUGH or np.ptp(y) == 0 or not groups:
        return None
    resampled = np.random.default_rng(0).integers(0, len(y), (RESAMPLES, len(y)))
    shares = lambda group: np.array([explained_share(y[pick], group[pick]) for pick in (np.arange(len(y)), *resampled)])
    estimates = {name: shares(group) for name, group in groups.items()}  # the estimate, then those of resampled trials
    num = max(2, min(BINS, int((len(y) / CELL) ** 0.5)))
    coarse = {name: groups_of(analysis.values[name], num) for name in groups}
    alone = {name: shares(group) for name, group in coarse.items()}
    for a, b in combinations(groups, 2):
        estimates[f"{a} with {b}"] = shares(num * coarse[a] + coarse[b]) - alone[a] - alone[b]
    spread = {name: np.nanpercentile(values[1:] - values[0], [2.5, 97.5]) for name, values in estimates.items()}
    return {name: (float(values[0]), float(values[0] - spread[name][1]), float(values[0] - spread[name][0]))
            for name, values in estimates.items()}  # fmt: skip


def to_json(analysis: Analysis, shares: Shares | None) -> dict[str, Any]:
    """Return the content of results.json."""
    row = lambda i: (
        {"trial": analysis.ids[i], "objective": float(analysis.objective[i]), "second": float(analysis.second[i])}
        | {
            name: analysis.labels[name][int(values[i])] if name in analysis.labels else float(values[i])
            for name, values in analysis.values.items()
        }
    )
    return {
        "objective": analysis.config.objective,
        "second": analysis.config.second,
        "status": analysis.status,
        "without_objective": analysis.num_without,
        "best": [row(i) for i in range(min(20, len(analysis.ids)))],
        "front": [row(i) for i in analysis.front],
        "sensitivity": shares and {name: {"share": cell[0], "ci95": list(cell[1:])} for name, cell in shares.items()},
    }


def best_trials(results: dict[str, Any]) -> list[tuple[str, ...]]:
    """Format the best trials as a table with a header row; empty where there is none."""
    rows = results["best"][:10]
    head = {"objective": results["objective"], "second": results["second"]}
    return [tuple(head.get(name, name) for name in row) for row in rows[:1]] + [
        tuple(map(cell, row.values())) for row in rows
    ]
