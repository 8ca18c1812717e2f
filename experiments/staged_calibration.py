"""Is a calibration by stages better than one at once? Simulated logs with a known truth, and public recordings.

`python -m experiments.staged_calibration --data FOLDER` writes `staged_calibration.json`: for both ways the estimates
with their intervals, on simulated logs how often these hold the truth, and the open-loop errors on held-out runs.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

import driftjax as dj

MANOEUVRES = ("coast_down", "throttle_steps", "laps", "step_steer", "slalom", "drift") * 2
HIDDEN = {"friction": (-0.2, 0.15), "steer_gain": (-0.1, 0.1), "steer_offset": (-0.02, 0.02),
          "drive_gain": (-0.25, 0.25), "rolling_resistance": (0.0, 0.02)}  # ranges  # fmt: skip
EFFECTS = dj.effects_to_fit(staged=True)
FITTED = (*EFFECTS, "gyro_bias", "sideslip_bias")
CATALOGUE = dj.effects_by_name((*FITTED, "drive_split", "brake_split"))  # what else a car has: smaller programs
RATE = 25.0  # of simulated logs [Hz]
BESIDE = ("sliding_friction.k=0.15", "load_transfer_long.h=0.5")  # hidden and not fitted, on the car of 2.6 m


class Recording(NamedTuple):
    """A public recording, and what is fitted to it."""

    log: str
    columns: str
    vehicle: str
    runs: tuple[str, ...] = ()
    cut: float | None = None
    effects: tuple[str, ...] = EFFECTS


RECORDINGS = {
    "dart_slow_laps": Recording("dart_jetracer/low_grip.csv", "dart_jetracer", "dart",
                                ("slippery_16apr/*-16-21-24*", "slippery_16apr/*-17-02-48*"), 8.0),
    "dart_grip": Recording("dart_jetracer/grip.csv", "dart_jetracer", "dart", ("rubber_free/*",)),
    "genesis": Recording("genesis_g80/cpg_slow_lap.csv", "genesis_g80", "genesis_g80", cut=20.0,
                         effects=FITTED),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Config:
    """Compare calibrations by stages and at once."""

    data: Path | None = None
    """Folder with the recordings; left out: simulated logs only."""
    only: tuple[str, ...] = ()
    """Recordings to use; all where left out."""
    logs: int = 4
    """Simulated logs per car and kind."""
    cars: tuple[str, ...] = ("sedan", "rc")
    """Cars to simulate."""
    out: Path = Path("runs/staged-calibration")
    """Folder for the result."""


def main(cfg: Config) -> dict[str, Any]:
    """Calibrate all logs both ways, print and write JSON."""
    results: dict[str, Any] = {}
    for car in cfg.cars:
        for kind in ("right", "wrong"):
            for seed in range(cfg.logs):
                results[f"{car}, {kind} model, {seed}"] = simulated(car, kind == "wrong", seed)
    if cfg.data is not None:
        for name in cfg.only or RECORDINGS:
            results[name] = recorded(name, cfg.data)
    (cfg.out / "staged_calibration.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    return results


def recorded(name: str, data: Path) -> dict[str, Any]:
    """Calibrate a recording below the folder `data`."""
    one = RECORDINGS[name]
    log = dj.read_log(data / one.log, one.columns, runs=one.runs, cut=one.cut)
    return both(name, dj.load_vehicle(one.vehicle), log, one.effects, {})


def simulated(name: str, wrong: bool, seed: int) -> dict[str, Any]:
    """Calibrate a simulated log of a car with hidden effects; a `wrong` model lacks effects that are not fitted."""
    car, rng = dj.load_vehicle(name, combined_slip=1.0), np.random.default_rng((seed, len(name)))
    truth = {effect: float(rng.uniform(*ends)) for effect, ends in HIDDEN.items()}
    strengths = [
        f"{effect}.{'f' if effect == 'rolling_resistance' else 'p'}={value}" for effect, value in truth.items()
    ]
    beside = [one.replace("h=0.5", f"h={0.19 * (car.a + car.b):.3g}") for one in BESIDE] if wrong else []
    campaign = dj.Campaign(MANOEUVRES, duration=8.0, rate=RATE, seed=seed)
    runs, _ = dj.record_runs(car, dj.effect_strengths(car, strengths + beside), campaign)
    return both(f"{name}, {'wrong' if wrong else 'right'} model, {seed}", car, dj.Log(runs), EFFECTS, truth)


def both(
    name: str, car: dj.VehicleConfig, log: dj.Log, effects: tuple[str, ...], truth: dict[str, float]
) -> dict[str, Any]:
    """Calibrate `car` at once and by stages; print and return what comes out."""
    summaries = {}
    for way in ("at once", "staged"):
        begin = time.perf_counter()
        calibration = dj.calibrate(car, log, effects, staged=way == "staged", catalogue=CATALOGUE)
        now = summaries[way] = summary(calibration, truth) | {"time_s": time.perf_counter() - begin}
        print(f"\n{name}, {way}: {now['time_s']:.0f} s, error over that of the nominal car "
              f"{now['ratio']}, truth in {now['inside']} of {now['known']}\n{calibration}",
              flush=True)  # fmt: skip
    return summaries


def summary(calibration: dj.Calibration, truth: dict[str, float]) -> dict[str, Any]:
    """Return estimates, errors on held-out runs, and the errors of estimates whose `truth` is known; 0 if not there."""
    parameters = [one._asdict() for one in calibration.parameters]
    off = {
        one.parameter: (one.value - truth.get(one.parameter.split(".")[0], 0.0)) / one.ci95_half
        for one in calibration.parameters
        if truth and not one.dead
    }
    gain = calibration.gain
    return {
        "parameters": parameters,
        "off": off,  # in half-widths of the interval
        "known": len(off),
        "inside": sum(abs(value) <= 1 for value in off.values()),
        "ratio": None if gain is None else gain.ratios["fitted"].round(4).tolist(),
        "rms": None if gain is None else rms_ahead(calibration.content()["gain"], tuple(gain.errors)),
    }


def rms_ahead(gain: dict[str, Any], models: tuple[str, ...]) -> dict[str, list[float]]:
    """Return the RMS errors of V, beta and r of each of `models` at the horizon that decides, 2 sqrt(L/g)."""
    at = gain["horizons_s"].index(gain["skill_horizon_s"])
    return {name: [gain["rmse"][name][channel][at] for channel in ("V", "beta", "r")] for name in models}


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, prog="python -m experiments.staged_calibration"))
    except dj.BadInput as error:
        sys.exit(f"staged_calibration: {error}")
