"""Measure the closed-loop gain: the corner of `driftjax learn`, driven with each model in the MPC on the same plant."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from driftjax.core import BadInput, read_yaml
from driftjax.diagnosis.diagnose import Diagnosis
from driftjax.learning.config import LearnConfig, load_learn_config
from driftjax.learning.metrics import difference
from driftjax.learning.scenario import build_scenario, route_of
from driftjax.learning.stage import StageResult
from driftjax.learning.stages import drive_nominal
from driftjax.manoeuvres.truth import read_truth
from driftjax.parallel import num_workers, process_executor
from driftjax.report import CLOSED_LOOP
from driftjax.sim import AnyPlant, LapCode, batch_of, load_any_plant, plant_of
from driftjax.store import RunFolder
from driftjax.track import load_track
from driftjax.vehicle import VehicleConfig

CARS = ("sedan", "rc", "dart")  # with shipped settings of `driftjax learn`
SEEDS = 4  # of the sensor noise, the same for each model


@dataclasses.dataclass(frozen=True)
class ClosedLoopCase:
    """Plant and options of the closed-loop laps."""

    name: str  # of the plant, as typed
    plant: AnyPlant
    config: LearnConfig


def load_case(plant: Path, vehicle: VehicleConfig) -> ClosedLoopCase:
    """Load the corner of `vehicle` and its plant: a truth.yaml, a plant or vehicle YAML, or a shipped plant."""
    if vehicle.name not in CARS:
        raise BadInput(f"--closed-loop: the corner of a car called '{vehicle.name}' is not known; its vehicle YAML "
                       f"needs 'name' {', '.join(CARS[:-1])} or {CARS[-1]}.")  # fmt: skip
    config = load_learn_config(vehicle.name).nothing_learnt
    config = dataclasses.replace(config, plants=1, noise_seeds=SEEDS, controllers=("path",), plant=())
    lap, step = float(load_track(config.track).length), config.mpc.dt / config.lap.substeps
    if plant.is_file() and read_yaml(plant).keys() & {"vehicle", "campaign"}:  # which no plant or vehicle YAML holds
        car, theta, _ = read_truth(plant)
        return ClosedLoopCase(str(plant), plant_of(car, theta, lap, step), config)
    return ClosedLoopCase(
        str(plant), jax.tree.map(lambda a: a[0], batch_of([load_any_plant(plant)], lap, step)), config
    )


def without_estimates(vehicle: VehicleConfig, extended: VehicleConfig) -> VehicleConfig:
    """Return `extended` with its effects at their initial values: the car `vehicle` in the same compiled program."""
    start = {one.name: one.value for one in vehicle.effects}
    effects = (dataclasses.replace(e, value=start.get(e.name, 0.0), ci95_half=None) for e in extended.effects)
    return dataclasses.replace(extended, effects=tuple(effects), covariance=())


def closed_loop(case: ClosedLoopCase, nominal: VehicleConfig, extended: VehicleConfig) -> dict[str, Any]:
    """Return the content of `closed_loop` in diagnosis.json: laps of the nominal and the `extended` car as models.

    Planner, reference and MPC are those of the nominal stage of `driftjax learn`. Lap by lap both models have the same
    sensor noise, so that their difference is paired.
    """
    models = {"nominal": without_estimates(nominal, extended)}
    if extended.effects != nominal.effects:
        models |= {"extended": extended}
    laps: dict[str, StageResult] = {}
    models_content: dict[str, Any] = {}
    with process_executor(num_workers(SEEDS), fused=True) as executor:
        for name, vehicle in models.items():
            try:
                scenario = build_scenario(
                    case.config, executor, route_of(case.config, vehicle), (case.name, case.plant)
                )
            except BadInput as error:  # of the corner on this car: the diagnosis stands without it
                models_content[name] = {"not_driven": str(error)}
                continue
            laps[name], _ = drive_nominal(scenario, 0)
            models_content[name] = summarise_laps(laps[name])
    compared = compare_laps(laps["nominal"], laps["extended"]) if len(laps) == 2 else None
    return {"plant": case.name, "corner": case.config.car, "controller": "path", "models": models_content,
            "difference": compared}  # fmt: skip


def add_closed_loop(run: RunFolder, case: ClosedLoopCase, diagnosis: Diagnosis) -> dict[str, Any]:
    """Drive the laps of `closed_loop` for a `diagnosis` saved in `run`, and add them to its diagnosis.json."""
    laps = closed_loop(case, diagnosis.vehicle, diagnosis.extended)
    run.write_json("diagnosis", run.read_json("diagnosis") | {"closed_loop": laps})
    return run.read_json("diagnosis")["closed_loop"]


def summarise_laps(stage: StageResult) -> dict[str, Any]:
    """Return how the laps of one model ended, and figures per seed with their means.

    A velocity error refers to the driven part of the drift section; for failed laps it is meaningless and omitted.
    """
    codes, laps = np.asarray(stage.laps.code), stage.figures
    done = np.asarray(laps.completed)
    values = {name: np.asarray(getattr(laps, name), float) for name in CLOSED_LOOP}
    values["velocity_rmse"] = np.where(done, values["velocity_rmse"], np.nan)
    means = {name: float(np.mean(v[np.isfinite(v)])) if np.isfinite(v).any() else None for name, v in values.items()}
    return {
        "completed": [int(done.sum()), len(done)],
        "codes": [LapCode(int(code)).name for code in codes],
        **{name: {"mean": means[name], "per_seed": v.tolist()} for name, v in values.items()},
    }


def compare_laps(nominal: StageResult, extended: StageResult) -> dict[str, Any]:
    """Return extended minus nominal with intervals over seeds; velocity errors only of laps that both completed."""
    both = np.asarray(nominal.figures.completed & extended.figures.completed)
    every = np.ones_like(both)
    pairs = {"lateral_error": every, "velocity_rmse": both, "drift_share": every}
    return {
        name: difference(*(np.asarray(getattr(one.figures, name))[chosen] for one in (nominal, extended)))
        for name, chosen in pairs.items()
    }
