"""What differs between runs of a real 1:6 car and those of its simulation on the same paths?

`python -m experiments.paired_runs --data FOLDER` with a copy of uwsbel/sbel-reproducibility fits the steering of the
nominal car to the simulated runs of each path, compares real with simulated ones, and writes a run folder with its
report per path and `paired_runs.json`.

The files have neither names of columns nor times, and nothing there describes them. Columns 1 to 4 fit each other as
position, heading and speed, and the last is the steering, from -1 to 1. The sample time is the length of the path over
the mean speed; the yaw rate is the derivative of the heading, as there is no other.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import driftjax as dj

FOLDER = "2024/PathFollowingSim2real/TestingData"
PATHS = ("rd_path", "syn_path", "lot17")
REAL = {"rd_path": ("pid_1", "mpc_1", "nn_mc_1", "nn_mpc_1"), "syn_path": ("pid_1", "mpc_1", "nn_mc_1", "nn_mpc_1"),
        "lot17": ("pid_1", "pid_2", "mpc_1", "mpc_2")}  # fmt: skip
SIMULATED = ("sim_pid", "sim_mpc", "sim_nn_mc", "sim_nn_mpc")
STEERING = ("steer_gain", "steer_lag", "steer_delay", "steer_offset")
RATE = 10.0  # Hz, about that of the files
STEERS = 0.1  # rad
SLOW = 0.4  # m/s: below it the car starts or stops
# 2023/Unjhawala-IEEE-ExpressiveVM/VM/jsons/dART.json there: mass, inertia, axles, full steering; the tyre is chosen
CAR = dj.VehicleConfig(name="dart_1_6", m=5.764, Iz=0.350, a=0.268, b=0.197, mu=0.9, B=8.0, C=1.3, width=0.32,
                       length=0.6, delta_max=0.436, delta_rate_max=4.0, Fxr_min=-25.0, Fxr_max=25.0,
                       Fxr_rate_max=250.0)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Config:
    """Compare real with simulated runs."""

    data: Path = Path("sbel-reproducibility")
    """Copy of the repository."""
    only: tuple[str, ...] = PATHS
    """Paths that were driven."""
    compare: bool = True
    """Compare; otherwise only say how far the cars turn."""
    seconds: float = 30.0
    """Of every run, from its start, that are compared."""
    most: int = 3
    """Effects named in each log, and differences, at most: the search for eight takes more than 45 min."""
    cut: float = 15.0
    """Length of the parts of a run [s]."""
    out: Path = Path("runs/paired-runs")
    """Folder for results; paths that it holds are not compared again."""


def main(cfg: Config) -> dict[str, Any]:
    """Compare the runs of each path and write the results after each."""
    if unknown := sorted(set(cfg.only) - set(PATHS)):
        raise dj.BadInput(f"path '{unknown[0]}': choose from {', '.join(PATHS)}.")
    path, results = cfg.out / "paired_runs.json", {}
    path.parent.mkdir(parents=True, exist_ok=True)
    for name in cfg.only:
        logs = [read_runs(cfg.data / FOLDER / name, files) for files in (REAL[name], SIMULATED)]
        real, simulated = ([round(turning(run), 3) for run in log.runs] for log in logs)
        results[name] = {"turning": {"real": real, "simulated": simulated}}
        if cfg.compare:
            results[name] |= compared(logs, cfg, name)
        print(name, results[name], flush=True)
        path.write_text(json.dumps(results, indent=1), encoding="utf-8")
    return results


def compared(logs: list[dj.Log], cfg: Config, name: str) -> dict[str, Any]:
    """Return what differs between the runs of one path, or read it from the folder that holds it."""
    folder = cfg.out / name
    if not (folder / "compare.json").is_file():
        real, simulated = (first_seconds(log, cfg.seconds).split_runs(cfg.cut) for log in logs)
        say = lambda text: print(f"{name}: {text}", flush=True)
        car = dj.calibrate(CAR, simulated, STEERING, report=say).vehicle
        dj.compare(car, real, simulated, dj.CompareConfig(most=cfg.most), report=say).save(folder)
    content = json.loads((folder / "compare.json").read_text(encoding="utf-8"))
    return {key: content[key] for key in ("verdict", "sentence", "differences")}


def first_seconds(log: dj.Log, seconds: float) -> dj.Log:
    """Return the log with the first `seconds` of every run."""
    return dj.Log(tuple(part for run in log.runs for part in dj.Log((run,)).split_runs(seconds).runs[:1]))


def turning(run: dj.Run) -> float:
    """Return the median of the yaw rate over that of a car without slip, where it steers."""
    steers = np.abs(run.delta) > STEERS
    return float(np.median((run.r * (CAR.a + CAR.b) / (run.V * np.tan(run.delta)))[steers]))


def read_runs(folder: Path, names: tuple[str, ...]) -> dj.Log:
    """Read the runs as a log."""
    return dj.Log(tuple(read_run(folder / f"{name}.csv") for name in names))


def read_run(path: Path) -> dj.Run:
    """Read one run; raises `BadInput` if the file is not there."""
    if not path.is_file():
        raise dj.BadInput(f"{path}: no such file; give --data the folder of a copy of the repository.")
    values = np.genfromtxt(path, delimiter=",")
    x, y, psi, V, steering = values[:, [0, 1, 2, 3, 8]].T
    moving = np.flatnonzero((V > SLOW) & (np.hypot(np.gradient(x), np.gradient(y)) > 0))  # they end standing still
    rows = slice(moving[0], moving[-1] + 1)
    length, duration = np.hypot(np.diff(x[rows]), np.diff(y[rows])).sum(), (rows.stop - rows.start - 1)
    step = length / np.mean(V[rows]) / duration
    measured = step * np.arange(duration + 1)
    t = np.arange(0.0, measured[-1], 1 / RATE)
    good = V[rows] > 0  # a sample or two are off by far
    at = lambda series: np.interp(t, measured[good], series[rows][good])
    heading = at(np.unwrap(psi))
    delta = at(CAR.delta_max * np.clip(steering, -1, 1))
    none = np.full_like(t, np.nan)
    return dj.Run(path.stem, t, at(V), none, np.gradient(heading, 1 / RATE), delta, none, 1 / RATE,
                  {"x": at(x), "y": at(y), "psi": heading})  # fmt: skip


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, prog="python -m experiments.paired_runs"))
    except dj.BadInput as error:
        sys.exit(f"paired_runs: {error}")
