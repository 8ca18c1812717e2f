"""driftjax: a differentiable, jit-compiled car in JAX that learns to drift, and that explains measured logs.

What follows is the public interface; everything is imported when it is first used. Units are SI and radians, left
is positive (ISO 8855). Importing the package sets up JAX (float64, compilation cache, threads): see `setup`.
"""

import importlib
from typing import TYPE_CHECKING

from driftjax.environment import __version__ as __version__
from driftjax.environment import setup as setup

if TYPE_CHECKING:
    from driftjax.control.drift_mpc import DriftMPC as DriftMPC
    from driftjax.control.drift_mpc import MPCState as MPCState
    from driftjax.control.drift_mpc import mpc_state as mpc_state
    from driftjax.control.drift_mpc import steady_reference as steady_reference
    from driftjax.control.mpc import MPCConfig as MPCConfig
    from driftjax.control.mpc import Reference as Reference
    from driftjax.control.mpc import Weights as Weights
    from driftjax.core import RESULTS as RESULTS
    from driftjax.core import BadInput as BadInput
    from driftjax.core import Control as Control
    from driftjax.core import State as State
    from driftjax.diagnosis.calibrate import Calibration as Calibration
    from driftjax.diagnosis.calibrate import calibrate as calibrate
    from driftjax.diagnosis.calibrate import effects_to_fit as effects_to_fit
    from driftjax.diagnosis.compare import CompareConfig as CompareConfig
    from driftjax.diagnosis.compare import LogComparison as LogComparison
    from driftjax.diagnosis.compare import compare as compare
    from driftjax.diagnosis.diagnose import Diagnosis as Diagnosis
    from driftjax.diagnosis.diagnose import diagnose as diagnose
    from driftjax.diagnosis.held_out import DiagnoseConfig as DiagnoseConfig
    from driftjax.equilibrium.branch import Branch as Branch
    from driftjax.equilibrium.map import MapConfig as MapConfig
    from driftjax.equilibrium.map import equilibria as equilibria
    from driftjax.equilibrium.map import write_map as write_map
    from driftjax.export import Export as Export
    from driftjax.export import export_car as export_car
    from driftjax.export import export_mpc as export_mpc
    from driftjax.gp import GP as GP
    from driftjax.gp import KernelGP as KernelGP
    from driftjax.gp import fit_gp as fit_gp
    from driftjax.gp import fit_kernel as fit_kernel
    from driftjax.learning.config import LearnConfig as LearnConfig
    from driftjax.learning.config import load_learn_config as load_learn_config
    from driftjax.learning.run import learn as learn
    from driftjax.logs import Guess as Guess
    from driftjax.logs import Log as Log
    from driftjax.logs import Run as Run
    from driftjax.logs import guess_columns as guess_columns
    from driftjax.logs import inspect as inspect
    from driftjax.logs import read_log as read_log
    from driftjax.logs import write_log as write_log
    from driftjax.manoeuvres.campaign import Campaign as Campaign
    from driftjax.manoeuvres.campaign import record_runs as record_runs
    from driftjax.manoeuvres.truth import effect_strengths as effect_strengths
    from driftjax.manoeuvres.truth import write_truth as write_truth
    from driftjax.planner import PlanConfig as PlanConfig
    from driftjax.planner import load_plan_config as load_plan_config
    from driftjax.planner import plan as plan
    from driftjax.report import save_film as save_film
    from driftjax.report import save_plan as save_plan
    from driftjax.report import write_comparison as write_comparison
    from driftjax.report import write_diagnosis as write_diagnosis
    from driftjax.report import write_page as write_page
    from driftjax.report import write_report as write_report
    from driftjax.sim import LapCode as LapCode
    from driftjax.sim import LapConfig as LapConfig
    from driftjax.sim import drive_laps as drive_laps
    from driftjax.sim import simulate as simulate
    from driftjax.store import RunFolder as RunFolder
    from driftjax.store import list_runs as list_runs
    from driftjax.studies.sweepable_verbs import run_sweep as run_sweep
    from driftjax.sweep import SweepConfig as SweepConfig
    from driftjax.sweep import SweepResult as SweepResult
    from driftjax.sweep.query import find_laps as find_laps
    from driftjax.track import Track as Track
    from driftjax.track import load_track as load_track
    from driftjax.tune.config import TuneConfig as TuneConfig
    from driftjax.tune.run import tune_mpc as tune_mpc
    from driftjax.tyre import MagicFormula2012 as MagicFormula2012
    from driftjax.tyre import TyreFile as TyreFile
    from driftjax.tyre import fit_tir as fit_tir
    from driftjax.tyre import magic_formula as magic_formula
    from driftjax.tyre import read_tir as read_tir
    from driftjax.tyre import write_tir as write_tir
    from driftjax.vehicle import PlantConfig as PlantConfig
    from driftjax.vehicle import Residual as Residual
    from driftjax.vehicle import VehicleConfig as VehicleConfig
    from driftjax.vehicle import build_car as build_car
    from driftjax.vehicle import draw_plants as draw_plants
    from driftjax.vehicle import effects_by_name as effects_by_name
    from driftjax.vehicle import load_plant as load_plant
    from driftjax.vehicle import load_vehicle as load_vehicle
    from driftjax.vehicle import unmodelled_effects as unmodelled_effects
    from driftjax.vehicle import with_effects as with_effects
    from driftjax.vehicle import write_vehicle as write_vehicle

MODULES = {
    "control.drift_mpc": ("DriftMPC", "MPCState", "mpc_state", "steady_reference"),
    "control.mpc": ("MPCConfig", "Reference", "Weights"),
    "core": ("RESULTS", "BadInput", "Control", "State"),
    "diagnosis.calibrate": ("Calibration", "calibrate", "effects_to_fit"),
    "diagnosis.compare": ("CompareConfig", "LogComparison", "compare"),
    "diagnosis.diagnose": ("Diagnosis", "diagnose"),
    "diagnosis.held_out": ("DiagnoseConfig",),
    "equilibrium.branch": ("Branch",),
    "equilibrium.map": ("MapConfig", "equilibria", "write_map"),
    "export": ("Export", "export_car", "export_mpc"),
    "gp": ("GP", "KernelGP", "fit_gp", "fit_kernel"),
    "learning.config": ("LearnConfig", "load_learn_config"),
    "learning.run": ("learn",),
    "logs": ("Guess", "Log", "Run", "guess_columns", "inspect", "read_log", "write_log"),
    "manoeuvres.campaign": ("Campaign", "record_runs"),
    "manoeuvres.truth": ("effect_strengths", "write_truth"),
    "planner": ("PlanConfig", "load_plan_config", "plan"),
    "report": ("save_film", "save_plan", "write_comparison", "write_diagnosis", "write_page", "write_report"),
    "sim": ("LapCode", "LapConfig", "drive_laps", "simulate"),
    "store": ("RunFolder", "list_runs"),
    "studies.sweepable_verbs": ("run_sweep",),
    "sweep": ("SweepConfig", "SweepResult"),
    "sweep.query": ("find_laps",),
    "track": ("Track", "load_track"),
    "tune.config": ("TuneConfig",),
    "tune.run": ("tune_mpc",),
    "tyre": ("MagicFormula2012", "TyreFile", "fit_tir", "magic_formula", "read_tir", "write_tir"),
    "vehicle": (
        "PlantConfig",
        "Residual",
        "VehicleConfig",
        "build_car",
        "draw_plants",
        "effects_by_name",
        "load_plant",
        "load_vehicle",
        "unmodelled_effects",
        "with_effects",
        "write_vehicle",
    ),
}
PUBLIC = {name: f"driftjax.{module}" for module, names in MODULES.items() for name in names}
__all__ = ["setup", *PUBLIC]  # pyright: ignore[reportUnsupportedDunderAll]

setup()


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that `driftjax --help` need not wait for JAX."""
    if name not in PUBLIC:
        raise AttributeError(f"module 'driftjax' has no attribute '{name}'; it has {', '.join(__all__)}.")
    value = getattr(importlib.import_module(PUBLIC[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *PUBLIC])
