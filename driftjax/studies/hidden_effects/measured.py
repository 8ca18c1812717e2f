"""Measured logs of a case: a car with hidden effects, or a foreign simulator."""

import dataclasses

from driftjax.logs import Run
from driftjax.manoeuvres.campaign import Campaign, record_runs
from driftjax.studies.hidden_effects.case import FOREIGN, Case
from driftjax.studies.hidden_effects.foreign import foreign_runs, foreign_vehicle
from driftjax.vehicle import VehicleConfig, load_vehicle
from driftjax.vehicle.effect import EFFECTS

ATTEMPTS = 4  # at runs in which the car does not spin
APART = 2**32  # between the seeds of attempts


def nominal_vehicle(case: Case) -> VehicleConfig:
    """Return the nominal car of a case, with a friction circle for drifts."""
    if case.car in FOREIGN:
        return foreign_vehicle()
    return dataclasses.replace(load_vehicle(case.car), combined_slip=1.0)


def measured_runs(case: Case, vehicle: VehicleConfig) -> tuple[Run, ...]:
    """Return the runs of a case; a run that spins is driven again, and omitted when it always does."""
    if case.car in FOREIGN:
        return foreign_runs(case.car, case.seed, case.noise)
    theta, found = case.theta(tuple(EFFECTS.values())), dict[str, Run]()
    campaign = Campaign(case.manoeuvres, noise=case.noise, process_noise=case.process_noise, seed=case.seed)
    for attempt in range(ATTEMPTS):
        runs, truth = record_runs(vehicle, theta, dataclasses.replace(campaign, seed=case.seed + attempt * APART))
        found = {run.name: run for run in runs} | found
        missing = set(truth.left_out) - set(found)
        if not missing:
            break
    return tuple(found[name] for name in sorted(found, key=lambda name: int(name.rsplit("-", 1)[1])))
