"""A made-up diagnosis on disk: rear friction is missing, one run held out."""

import dataclasses
from pathlib import Path

import numpy as np

from driftjax.store import DIAGNOSIS, RunFolder, dataset
from driftjax.vehicle import load_vehicle

EFFECTS = ("friction_rear", "stiffness_rear", "aero_drag", "steer_lag", "gyro_bias", "yaw_inertia")
DRIVERS = ("slip_front", "slip_rear", "drive", "speed", "time", "heading", "position")


def values(named: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Everything `diagnosis.nc` holds."""
    rng = np.random.default_rng(0)
    K, t, ahead = len(EFFECTS), np.arange(1000) * 0.01, np.linspace(0.01, 2.0, 100)
    start = np.arange(0.5, 9, 2.0)
    measured = np.stack([np.stack([12 + np.sin(t), 0.5 * np.sin(t), np.cos(t)], axis=1)] * 2)
    measured[1, 700:] = np.nan
    at = start[:, None] + ahead
    true = np.stack([12 + np.sin(at), 0.5 * np.sin(at), np.cos(at)], axis=-1)
    off = np.array([0.3, 0.0])[:, None, None, None] * ahead[:, None]
    size = np.array([1.0, 0.1])[:, None, None, None]
    score = np.array([9.0, 6.5, 1.0, 0.6, 2.9, 0.0])
    rise = np.stack([0.1 * ahead**2, 0.01 * ahead, 0.02 * ahead], axis=1)
    bins = np.linspace(-1, 1, 10) * np.array([0.2, 0.5, 3000, 15, 10, 3, 300])[:, None]
    names = np.array([f"{name}.p" for name in EFFECTS])
    return {
        "channel": np.array(["V", "beta", "r"]), "compared": np.array(["nominal", "retuned", "extended"]),
        "model": np.array(["nominal", "extended"]), "sigma": np.array([0.05, 0.0087, 0.0087]), "horizon": ahead,
        "rmse": np.stack([0.05 + 3 * rise, 0.05 + 2 * rise, 0.05 + rise]), "floor": 0.05 + 0.9 * rise,
        "panel": np.array(["drift2", "slalom5"]), "sample_time": t, "measured": measured,
        "delta": np.stack([0.1 * np.sin(t)] * 2), "Fxr": np.stack([3000 + 500 * np.cos(t)] * 2), "start_time": start,
        "ahead_time": ahead, "predicted": np.stack([true + off] * 2),
        "force": np.array(["Fx", "Fyf", "Fyr"]), "force_limit": np.array([7000.0, 8000.0, 7000.0]),
        "driver": np.array(DRIVERS), "bin_value": np.stack([bins, bins]),
        "bin_mean": 400 * size * np.sin(2 * bins[:, :, None] / bins.max(axis=1)[:, None, None]) * [0.1, 0.2, 1.0],
        "bin_error": np.full((2, 7, 10, 3), 40.0), "explained": rng.uniform(0, 0.6, (2, 7, 3)),
        "effect": np.array(EFFECTS), "promise": 10 * score**2,
        "parameter": names, "other": names, "score": score,
        "named": np.isin(EFFECTS, named), "cosine": np.clip(np.eye(K) + 0.96 * (rng.uniform(size=(K, K)) > 0.6), 0, 1),
        "lag_time": 0.01 * np.arange(1, 101),
        "autocorrelation": np.stack([np.exp(-ahead), 0.02 * rng.normal(size=100)])[:, :, None] * np.ones(3),
    }  # fmt: skip


def diagnosis_content(named: tuple[str, ...]) -> dict:
    """What `diagnosis.json` holds."""
    channels = lambda *rows: dict(zip(("V", "beta", "r"), rows, strict=True))
    four = lambda last: [0.05, 0.1, last / 2, last]
    force = {"rms_N": 300.0, "rms_extended_N": 90.0, "share_of_limit": 0.04, "worst_variable": "slip_rear",
             "explained": dict.fromkeys(DRIVERS, 0.1) | {"slip_rear": 0.6}}  # fmt: skip
    causes = [
        {"effect": name, "probability": 0.9, "p_value": 0.001, "confusable_with": ["stiffness_rear"],
         "family": "rear tyre", "family_probability": 0.98, "share": 1.0, "share_ci95": [0.9, 1.0],
         "rivals": {"stiffness_rear": 0.08}, "parameters": {"p": {"value": -0.1, "ci95": [-0.12, -0.08], "unit": "1"}},
         "curve": {"axle": "rear", "slip": [0.0, 0.2, 0.4], "nominal": [0.0, 1.0, 0.95], "fitted": [0.0, 0.95, 0.85],
                   "band": [[0.0, 0.9, 0.8], [0.0, 1.0, 0.9]]}}
        for name in named
    ]  # fmt: skip
    return {
        "schema": 1, "verdict": "NAMED" if named else "NOTHING", "sentence": "Rear friction differs <a lot>.",
        "causes": causes, "explained": {"share": 0.8, "ci95": [0.7, 0.9], "horizon": 1.0},
        "gain": {"held_out_runs": ["drift2"], "horizons_s": [0.01, 0.5, 1.0, 2.0], "skill_horizon_s": 1.0,
                 "without": {"friction_rear": channels([1.2, 1.1, 1.3], [1.5, 1.4, 1.6], [None, None, None])},
                 "skill": {"extended": 0.8},
                 "ci95": {"extended": [0.7, 0.9]}, "ratio": {"extended": [0.5, 0.4, 0.3, None]},
                 "ratio_ci95": {"extended": [[0.4, 0.6], [0.3, 0.5], [0.2, 0.4], [None, None]]},
                 "rmse": {name: channels(four(1.0), four(0.5), [0.1, None, None, None])
                          for name in ("nominal", "extended", "noise_floor")}},
        "next_manoeuvre": {"manoeuvre": "throttle_steps"},
        "show": {
            "open_loop": {"horizons_s": [0.01, 0.5], "in_noises": channels([1.0, 2.0], [1.0, 3.0], [1.0, None])},
            "residual_forces": {"p_value": 0.002, "Fx": force | {"worst_variable": None}, "Fyf": force, "Fyr": force},
            "kinematic_parity": None, "worst": "The lateral force of the rear axle is off most.",
        },
        "data": {"rows": 1000}, "seed": 0,
    }  # fmt: skip


def diagnosed(path: Path, named: tuple[str, ...] = ("friction_rear",), drivers: bool = True) -> RunFolder:
    """A finished diagnosis below `path`."""
    config = {"vehicle": dataclasses.asdict(load_vehicle("sedan")), "logs": ["log.csv"]}
    run, data = RunFolder.create(path, config, "diagnose"), values(named)
    if not drivers:
        for name in ("driver", "bin_value", "bin_mean", "bin_error", "explained"):
            data[name] = data[name][:0] if name == "driver" else data[name][:, :0]
    attrs = {"car": "sedan", "predicted_on": "runs held out", "score_threshold": 3.0, "white_band": 0.02}
    run.write_dataset("diagnosis.nc", dataset(data, attrs, DIAGNOSIS))
    run.write_json("diagnosis", diagnosis_content(named))
    return run
