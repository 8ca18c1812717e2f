"""Definition of all stored variables: of a lap stage, a plan and a diagnosis, with units and meaning."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike


class Variable(NamedTuple):
    """Dimensions, units and name of a stored variable."""

    dims: tuple[str, ...]
    units: str
    long_name: str


FEATURES = ("V", "beta", "r", "delta", "Fxr")
OUTPUTS = ("dV", "dbeta", "dr")
INPUTS = ("delta", "Fxr")
COORDINATES = ("t", "feature", "output", "input", "car_parameter", "plant", "controller", "seed")
LABELS = ("channel", "compared", "model", "panel", "force", "driver", "effect", "parameter", "other")  # of a diagnosis
SHARED = ("t", "feature", "output", "input", "car_parameter")  # coordinates that do not differ between stages

_STEP = ("lane", "step")
_MEASURED = {
    "V": ("m/s", "speed of the centre of mass"),
    "beta": ("rad", "sideslip, left positive"),
    "r": ("rad/s", "yaw rate, left positive"),
    "x": ("m", "position"),
    "y": ("m", "position"),
    "psi": ("rad", "heading, left positive"),
    "s": ("m", "arc length along the planned path"),
    "e": ("m", "lateral error against the planned path, left positive"),
    "theta": ("rad", "heading less that of the planned path, left positive"),
}

STAGE: dict[str, Variable] = {
    **{name: Variable(_STEP, units, f"true {words}") for name, (units, words) in _MEASURED.items() if name != "theta"},
    **{f"{name}_measured": Variable(_STEP, units, f"measured {words}") for name, (units, words) in _MEASURED.items()},
    "t": Variable(("step",), "s", "time from the start of the lap"),
    "alive": Variable(_STEP, "1", "whether the lap was still being driven"),
    "delta_command": Variable(_STEP, "rad", "commanded steering angle, left positive"),
    "Fxr_command": Variable(_STEP, "N", "commanded longitudinal force of the rear axle, driving positive"),
    "delta": Variable(_STEP, "rad", "steering angle reached, left positive"),
    "Fxr": Variable(_STEP, "N", "longitudinal force of the rear axle reached, driving positive"),
    "drifting": Variable(_STEP, "1", "whether the drift controller drove, rather than pure pursuit"),
    "solved": Variable(_STEP, "1", "whether the optimal control problem was solved to tolerance"),
    "kkt": Variable(_STEP, "1", "scaled optimality error of the optimal control problem"),
    "num_steps": Variable(_STEP, "1", "solver iterations"),
    "V_ref": Variable(_STEP, "m/s", "reference speed"),
    "beta_ref": Variable(_STEP, "rad", "reference sideslip, left positive"),
    "r_ref": Variable(_STEP, "rad/s", "reference yaw rate, left positive"),
    "e_ref": Variable(_STEP, "m", "offset from the planned path that the reference asks for, left positive"),
    "plant": Variable(("lane",), "1", "name of the plant driven"),
    "controller": Variable(("lane",), "1", "name of the controller"),
    "seed": Variable(("lane",), "1", "noise seed"),
    "code": Variable(("lane",), "1", "how the lap ended"),
    "lateral_error": Variable(
        ("lane",), "m", "mean absolute lateral error against the planned path over the drift section"
    ),
    "lateral_error_measured": Variable(
        ("lane",), "m", "mean absolute measured lateral error over the drift section, by which laps are chosen"
    ),
    "lateral_error_max": Variable(
        ("lane",), "m", "largest absolute lateral error against the planned path over the drift section"
    ),
    "velocity_rmse": Variable(
        ("lane",), "m/s", "root-mean-square deviation from the reference speed over the drift section"
    ),
    "drift_share": Variable(("lane",), "1", "share of the drift section driven sideways"),
    "completed": Variable(("lane",), "1", "whether the lap was completed"),
    "feature": Variable(("feature",), "1", "input of the Gaussian process"),
    "gp_Z": Variable(("lane", "row", "feature"), "SI", "inputs of the Gaussian process: V, beta, r, delta, Fxr"),
    "gp_mask": Variable(("lane", "row"), "1", "whether the row of gp_Z is data, not padding"),
    "gp_std": Variable(
        ("lane", "step", "output"),
        "SI/s",
        "standard deviation of the Gaussian process where the car was, without noise",
    ),
    "output": Variable(("output",), "1", "output of the Gaussian process, a rate error"),
    "input": Variable(("input",), "1", "command of the driver"),
    "gate": Variable(
        ("lane", "output"), "1", "share of each learnt rate error that held-out rows support and that is used"
    ),
    "lags": Variable(("lane", "input"), "s", "learnt time constants of steering and drive"),
    "car_parameter": Variable(("car_parameter",), "1", "parameter fitted to each plant, effect.parameter"),
    "tuned": Variable(("lane", "car_parameter"), "SI", "its fitted value; 0 is the nominal car"),
    "reference_found": Variable(
        ("lane",), "1", "whether the reference was found on the lane's car; else the plan stood in"
    ),
    "reference_error": Variable(("lane",), "1", "scaled optimality error of the reference"),
    "vset_s": Variable(("lane", "point"), "m", "arc length of the points of the speed sets"),
    "vset_origin": Variable(("lane", "point"), "m/s", "speed that the sets start from"),
    "vset_target": Variable(("lane", "point"), "m/s", "trend r_b e of the change of speed"),
    "vset_V": Variable(("lane", "set", "point"), "m/s", "generated speeds"),
    "vset_V_ep": Variable(("lane", "set"), "m/s", "cornering speed to explore of each set"),
    "vset_lower": Variable(("lane", "point"), "m/s", "lower bound of the generated speeds"),
    "vset_upper": Variable(("lane", "point"), "m/s", "upper bound of the generated speeds"),
    "grid_V": Variable(("candidate",), "m/s", "cornering speed of the candidate"),
    "grid_beta": Variable(("candidate",), "rad", "sideslip of the candidate, left positive"),
    "grid_excited": Variable(("candidate",), "1", "whether steering and drive of the candidate are excited"),
    "grid_drivable": Variable(("lane", "candidate"), "1", "whether a plan exists that stays on the road"),
    "grid_error": Variable(("lane", "candidate"), "m", "expected mean absolute lateral error of the candidate"),
    "grid_deviation": Variable(
        ("lane", "candidate"), "m", "standard deviation of its lateral error, root mean square over the drift section"
    ),
    "grid_on_road": Variable(("lane", "candidate"), "1", "least probability of staying on the road along its plan"),
    "grid_gain": Variable(
        ("lane", "candidate"), "m", "knowledge gradient: expected decrease of the least expected error by driving it"
    ),
    "grid_chosen": Variable(("lane",), "1", "index of the candidate driven"),
}

_NODE, _POINT = ("node",), ("point",)
PLAN: dict[str, Variable] = {
    "s": Variable(_NODE, "m", "arc length along the track's centre line"),
    "t": Variable(_NODE, "s", "time from the first node"),
    "V": Variable(_NODE, "m/s", "planned speed of the centre of mass"),
    "beta": Variable(_NODE, "rad", "planned sideslip, left positive"),
    "r": Variable(_NODE, "rad/s", "planned yaw rate, left positive"),
    "e": Variable(_NODE, "m", "offset from the centre line, left positive"),
    "theta": Variable(_NODE, "rad", "heading less that of the centre line, left positive"),
    "delta": Variable(_NODE, "rad", "planned steering angle, left positive"),
    "Fxr": Variable(_NODE, "N", "planned longitudinal force of the rear axle, driving positive"),
    "x": Variable(_NODE, "m", "position"),
    "y": Variable(_NODE, "m", "position"),
    "psi": Variable(_NODE, "rad", "heading of the car, left positive"),
    "S": Variable(_NODE, "m", "arc length along the planned path"),
    "drift": Variable(_NODE, "1", "whether the plan drifts here"),
    "track_x": Variable(("track_point",), "m", "centre line"),
    "track_y": Variable(("track_point",), "m", "centre line"),
    "left_x": Variable(("track_point",), "m", "left border"),
    "left_y": Variable(("track_point",), "m", "left border"),
    "right_x": Variable(("track_point",), "m", "right border"),
    "right_y": Variable(("track_point",), "m", "right border"),
    "path_s": Variable(_POINT, "m", "arc length along the planned path"),
    "path_x": Variable(_POINT, "m", "planned path"),
    "path_y": Variable(_POINT, "m", "planned path"),
    "path_psi": Variable(_POINT, "rad", "course along the planned path"),
    "path_kappa": Variable(_POINT, "1/m", "curvature of the planned path, positive in left turns"),
}

_CURVE, _FAN = ("compared", "step", "channel"), ("panel", "model", "start", "ahead", "channel")
_BIN = ("model", "driver", "bin")
DIAGNOSIS: dict[str, Variable] = {
    "channel": Variable(("channel",), "1", "measured channel: V [m/s], beta [rad], r [rad/s]"),
    "compared": Variable(("compared",), "1", "models whose predictions were measured"),
    "model": Variable(("model",), "1", "the car before and after naming"),
    "sigma": Variable(("channel",), "SI", "standard deviation of the measurement noise"),
    "horizon": Variable(("step",), "s", "time ahead of a prediction"),
    "rmse": Variable(_CURVE, "SI", "RMS error of open-loop predictions"),
    "floor": Variable(("step", "channel"), "SI", "RMS error of a right model: sensor noise and disturbances"),
    "panel": Variable(("panel",), "1", "run"),
    "sample_time": Variable(("sample",), "s", "time from the start of the piece of the run"),
    "measured": Variable(("panel", "sample", "channel"), "SI", "measured channel"),
    "delta": Variable(("panel", "sample"), "rad", "commanded steering angle, left positive"),
    "Fxr": Variable(("panel", "sample"), "N", "commanded longitudinal force of the rear axle, driving positive"),
    "start_time": Variable(("start",), "s", "time at which predictions start"),
    "ahead_time": Variable(("ahead",), "s", "time ahead of a prediction"),
    "predicted": Variable(_FAN, "SI", "open-loop prediction of a measured channel"),
    "force": Variable(("force",), "1", "drive force, lateral force of front and of rear axle"),
    "force_limit": Variable(("force",), "N", "friction times static load"),
    "driver": Variable(("driver",), "1", "what residual forces may go with"),
    "bin_value": Variable(_BIN, "SI", "mean of the driver in a bin"),
    "bin_mean": Variable((*_BIN, "force"), "N", "mean residual force in a bin"),
    "bin_error": Variable((*_BIN, "force"), "N", "standard error of that mean, robust to dependence in time"),
    "explained": Variable(("model", "driver", "force"), "1", "share of a force's variance that a driver explains"),
    "parameter": Variable(("parameter",), "1", "parameter of an effect, effect.parameter"),
    "effect": Variable(("effect",), "1", "effect of the catalogue"),
    "promise": Variable(("effect",), "1", "predicted fall of the cost with the effect's best linear step"),
    "score": Variable(("parameter",), "1", "studentised score of a parameter at the nominal car"),
    "named": Variable(("parameter",), "1", "whether the effect was named"),
    "other": Variable(("other",), "1", "parameter of an effect, effect.parameter"),
    "cosine": Variable(("parameter", "other"), "1", "magnitude of the cosine between two parameters' signatures"),
    "lag_time": Variable(("lag",), "s", "time between two innovations"),
    "autocorrelation": Variable(("model", "lag", "channel"), "1", "autocorrelation of whitened innovations"),
}


def dataset(
    values: Mapping[str, ArrayLike], attrs: Mapping[str, Any] | None = None, table: dict[str, Variable] = STAGE
) -> xr.Dataset:
    """Return a dataset of `values` with the dimensions, units and names of `table` (`STAGE`, `PLAN` or `DIAGNOSIS`).

    `code` takes `attrs["codes"]`, a mapping of meaning to number, as CF flags. Raises `KeyError` for a name
    that is not in the table and `ValueError` for an array of another rank or length.
    """
    attrs = dict(attrs or {})
    codes = attrs.pop("codes", None)
    if unknown := [name for name in values if name not in table]:
        raise KeyError(f"{unknown[0]} is not in the table of variables of driftjax.store.variables; add it there.")
    arrays: dict[str, xr.Variable] = {}
    for name, value in values.items():
        array, (dims, units, long_name) = np.asarray(value), table[name]
        if array.ndim != len(dims):
            raise ValueError(f"{name} has shape {array.shape}; it needs the dimensions {dims}.")
        if array.dtype.kind in "UO":
            array = array.astype(object)
        arrays[name] = xr.Variable(dims, array, {"units": units, "long_name": long_name})
    if codes and "code" in arrays:
        arrays["code"].attrs |= cf_flag_attributes(codes)
    coordinates = {id(STAGE): COORDINATES, id(DIAGNOSIS): LABELS}.get(id(table), ())
    coords = {name: arrays.pop(name) for name in coordinates if name in arrays}
    attrs = {key: int(value) if isinstance(value, bool) else value for key, value in attrs.items()}
    return xr.Dataset(arrays, coords, attrs)


def cf_flag_attributes(codes: Mapping[str, int]) -> dict[str, Any]:
    """Return the CF attributes `flag_values` and `flag_meanings` of a mapping from meaning to number."""
    return {"flag_values": np.array(list(codes.values()), np.int32), "flag_meanings": " ".join(codes)}


def code_names(data: xr.Dataset) -> dict[int, str]:
    """Return the meaning of every value of `code`, from its CF flags."""
    attrs = data["code"].attrs
    numbers = np.atleast_1d(attrs["flag_values"]).tolist()
    return dict(zip(numbers, str(attrs["flag_meanings"]).split(), strict=True))
