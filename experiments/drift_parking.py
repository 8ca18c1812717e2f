"""Is the delay of a real RC car found, which its authors count as about three steps of 1/30 s?

`python -m experiments.drift_parking --data FOLDER` with a copy of lasgroup/simulation_transfer (a car that is driven by
hand and parked by drifts, with motion capture) diagnoses the stretches in which it drives forwards, and writes the run
folder of a diagnosis.

The recordings are pickled transitions. They are read by an unpickler that makes arrays and nothing else.
"""

import dataclasses
import pickle
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

import driftjax as dj

FOLDER = "data/recordings_rc_car_v0/new_rc_car_env"
RECORDINGS = ("train_1", "train_2", "test_1")
RATE = 30.0  # Hz
SLOWEST, SIDEWAYS = 0.6, 1.2  # m/s forwards and rad of sideslip within which the car drives forwards
# numbers of car 1 with drifts in sim_transfer/sims/car_sim_config.py; one tyre stands for theirs of front and rear
STEERING, MOTOR, BACK_EMF = 0.634, 11.10, 1.317**2  # rad, N, N s/m
CAR = dj.VehicleConfig(name="drift_parking", m=1.65, Iz=0.0685, a=0.13, b=0.17, mu=0.62, B=4.0, C=1.35, width=0.19,
                       length=0.42, delta_max=STEERING, delta_rate_max=10.0, Fxr_min=-15.0, Fxr_max=15.0,
                       Fxr_rate_max=300.0)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Config:
    """Diagnose an RC car that drifts into parking positions."""

    data: Path = Path("simulation_transfer")
    """Copy of the repository."""
    shortest: float = 1.5
    """Of a stretch driven forwards [s]."""
    out: Path = Path("runs/drift-parking")
    """Folder for the diagnosis."""


class Transitions(NamedTuple):
    """Recorded transitions; position, heading, velocity in the room, yaw rate, and the last three actions."""

    observation: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    discount: np.ndarray
    next_observation: np.ndarray
    extras: Any = ()


class ArraysOnly(pickle.Unpickler):
    """Unpickler of transitions of arrays; raises `UnpicklingError` for anything else."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what the file may build."""
        if (module, name) == ("brax.training.types", "Transition"):
            return Transitions
        if (module, name) in (("numpy", "ndarray"), ("numpy", "dtype"), ("numpy.core.multiarray", "_reconstruct")):
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        raise pickle.UnpicklingError(f"it holds a {module}.{name}")


def main(cfg: Config) -> dj.Diagnosis:
    """Diagnose the stretches driven forwards, and write the result."""
    stretches = [run for name in RECORDINGS for run in forwards(cfg, name)]
    print(f"{len(stretches)} stretches, {sum(len(run.t) for run in stretches) / RATE:.0f} s")
    diagnosis = dj.diagnose(CAR, dj.Log(tuple(stretches)), dj.DiagnoseConfig(gp=False), report=print)
    print(diagnosis.verdict, diagnosis.sentence, sep="\n")
    dj.write_diagnosis(diagnosis.save(cfg.out))
    return diagnosis


def forwards(cfg: Config, name: str) -> list[dj.Run]:
    """Return the stretches of a recording in which the car drives forwards."""
    content = read_transitions(cfg.data / FOLDER / f"{name}.pickle")
    x, y, psi, vx, vy, r = np.asarray(content.observation, float)[:, :6].T
    steering, throttle = np.clip(np.asarray(content.action, float).T, -1.0, 1.0)
    ahead, left = np.cos(psi) * vx + np.sin(psi) * vy, np.cos(psi) * vy - np.sin(psi) * vx
    V, beta = np.hypot(ahead, left), np.arctan2(left, ahead)
    edge = np.flatnonzero(np.diff(((ahead > SLOWEST) & (np.abs(beta) < SIDEWAYS)).astype(int), prepend=0, append=0))
    rows = [slice(*pair) for pair in edge.reshape(-1, 2) if np.ptp(pair) >= cfg.shortest * RATE]
    columns = np.stack([V, beta, r, STEERING * steering, MOTOR * throttle - BACK_EMF * V, x, y, np.unwrap(psi)])
    return [stretch(f"{name}-{i}", columns[:, row]) for i, row in enumerate(rows)]


def stretch(name: str, columns: np.ndarray) -> dj.Run:
    """Return the run with the `columns` (8, n) V, beta, r, delta, Fxr, x, y, psi."""
    V, beta, r, delta, Fxr, x, y, psi = columns
    return dj.Run(name, np.arange(len(V)) / RATE, V, beta, r, delta, Fxr, 1 / RATE, {"x": x, "y": y, "psi": psi})


def read_transitions(path: Path) -> Transitions:
    """Read one recording; raises `BadInput` if it is not there or holds anything but arrays."""
    try:
        with path.open("rb") as stream:
            content = ArraysOnly(stream).load()
    except FileNotFoundError:
        raise dj.BadInput(f"{path}: no such file; give --data the folder of a copy of the repository.") from None
    except (pickle.UnpicklingError, EOFError) as error:
        raise dj.BadInput(f"{path}: is no recording of transitions ({error}).") from error
    if not isinstance(content, Transitions):
        raise dj.BadInput(f"{path}: is no recording of transitions (it holds a {type(content).__name__}).")
    return content


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, prog="python -m experiments.drift_parking"))
    except dj.BadInput as error:
        sys.exit(f"drift_parking: {error}")
