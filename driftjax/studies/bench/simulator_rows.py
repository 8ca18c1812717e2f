"""Measure the simulator: this package against numba and C++ on one core."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from driftjax.parallel import thread_executor
from driftjax.studies.bench.config import BenchConfig, Dtype, missing
from driftjax.studies.bench.rows import PartResult, Row, Timing, TimingCurve, alternate, measure_curve, timed
from driftjax.studies.bench.simulator import columns, double_track_steps, single_track_steps
from driftjax.vehicle import load_vehicle

VECTOR, NUMBA, SCALAR = "C++, vectorised, one core", "numba, one core", "C++, scalar, one core"
PACKAGES = {VECTOR: "g++", NUMBA: "numba", SCALAR: "g++"}
TARGETS: dict[tuple[str, Dtype], float] = {
    (VECTOR, "float32"): 0.6, (VECTOR, "float64"): 0.5, (NUMBA, "float32"): 8.0, (NUMBA, "float64"): 3.0,
}  # fmt: skip
PLANT_TARGET = 12.0
BATCHES = (1, 16, 256, 4096, 65536, 1048576)

Step = Callable[[], tuple[np.ndarray, ...]]


def measure_rows(cfg: BenchConfig) -> PartResult:
    """Measure all rows, and the curves if `cfg.plots`."""
    makers, vectorised = _peers()
    rows = []
    for dtype in cfg.dtype:
        mine = single_track_steps(dtype, cfg.cars)
        steps = {name: make(columns(cfg.cars, dtype)) for name, make in makers.items()}
        with thread_executor(cfg.cars, cfg.threads) as threads:
            calls = {"ours": mine, "plant": double_track_steps(dtype, cfg.cars, threads)} | steps
            times = alternate(cfg.repeats, {name: timed(call, cfg.cars) for name, call in calls.items()})
        states = tuple(map(np.asarray, mine()))
        for name, package in PACKAGES.items():
            facts = {"batch": cfg.cars, "dtype": dtype} | _facts(states, steps.get(name))
            facts |= {"vectorised": vectorised} if name == VECTOR and name in steps else {}
            what = f"single-track RK4 step, batch {cfg.cars}, {dtype}"
            rows.append(Row("simulator", what, "step", times["ours"], name, times.get(name), "faster",
                            TARGETS.get((name, dtype)), missing(package), facts))  # fmt: skip
        rows.append(_plant_row(times, cfg.cars, dtype))
    return PartResult(rows, _curves(cfg, makers) if cfg.plots else [])


def _plant_row(times: Mapping[str, Timing], num: int, dtype: Dtype) -> Row:
    what = f"double-track RK4 step, all effects, batch {num}, {dtype}"
    facts = {"batch": num, "dtype": dtype}
    return Row("simulator", what, "step", times["plant"], "the single-track step", times["ours"], "costs",
               PLANT_TARGET, facts=facts)  # fmt: skip


def _peers() -> tuple[dict[str, Callable[[tuple[np.ndarray, ...]], Step]], bool]:
    """Return makers of the steps of the installed peers, and whether g++ vectorised its loop."""
    car, makers, vectorised = load_vehicle("sedan"), {}, False
    if not missing("g++"):
        from driftjax.studies.bench import cpp_step

        vector, scalar = cpp_step.compiled("vector"), cpp_step.compiled("scalar")
        vectorised = vector.vectorised
        makers[VECTOR] = lambda table: cpp_step.cpp_steps(vector, car, table)
        makers[SCALAR] = lambda table: cpp_step.cpp_steps(scalar, car, table)
    if not missing("numba"):
        from driftjax.studies.bench import numba_step

        makers[NUMBA] = lambda table: numba_step.numba_steps(car, table)
    return makers, vectorised


def _facts(states: tuple[np.ndarray, ...], step: Step | None) -> dict[str, float]:
    """Return the largest relative difference of the states after the step."""
    if step is None:
        return {}
    apart = [np.max(np.abs(a - b)) / np.max(np.abs(b)) for a, b in zip(states, step(), strict=True)]
    return {"difference": float(max(apart))}


def _curves(cfg: BenchConfig, makers: Mapping[str, Callable[[tuple[np.ndarray, ...]], Step]]) -> list[TimingCurve]:
    sizes, repeats = ((cfg.cars,), 1) if cfg.quick else (BATCHES, cfg.repeats)
    curves = []
    for dtype in cfg.dtype:
        of_size: dict[str, Callable[[int], Callable[[], Any]]] = {
            f"driftjax, {dtype}": partial(single_track_steps, dtype)
        }
        for name, make in makers.items():
            of_size[f"{name}, {dtype}"] = lambda num, make=make, dtype=dtype: make(columns(num, dtype))
        for label, step in of_size.items():
            names = ("simulator", label, "cars side by side", "step")
            curves.append(measure_curve(repeats, names, sizes, lambda n, step=step: timed(step(n), n)))
    return curves
