"""Read and write vehicle YAML files: a nominal car, and the effects named by a diagnosis."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from driftjax.core import BadInput, find_config, from_dict, read_yaml, shown, write_text, written_float
from driftjax.tyre import nominal_tyre, read_tir
from driftjax.vehicle.effect import EFFECTS, Parameter, effects_by_name
from driftjax.vehicle.parameters import EffectParameterValue, EstimatedNoise, VehicleConfig
from driftjax.vehicle.single_track import G

ROUNDING = 1e-9  # share of its bound by which a value may exceed it: a fit ends on bounds, and YAML rounds
BESIDE = ("effects", "covariance", "noise")  # keys of a file that are not parameters of the nominal car
SYMMETRIC = 1e-6  # largest difference of mirrored entries of a covariance, over their standard deviations


def load_vehicle(name: str | Path, combined_slip: float | None = None) -> VehicleConfig:
    """Read a vehicle YAML: a path, or the name of a shipped car (`sedan`, `rc`).

    Keys are the parameters of the nominal car (`tyre`, a .tir file beside this one, stands for mu, B and C: the nearest
    ones at the static load of a wheel), at the top or below `nominal`, and for an extended car `effects`
    (effect -> parameter -> value in SI, or {value, ci95_half}), `covariance` ({parameters: [effect.parameter], matrix})
    and `noise` (see `EstimatedNoise`), as `driftjax diagnose` writes them into extended.yaml. `combined_slip` replaces
    the file's friction ellipse: 0 none (as published), 1 a circle. Raises `BadInput` that names file and key.
    """
    path = find_config("vehicle", name)
    content = read_yaml(path)
    effects, covariance, noise = content.pop("effects", {}), content.pop("covariance", None), content.pop("noise", None)
    nominal = content.pop("nominal") if "nominal" in content else None
    if nominal is not None and content:
        raise BadInput(
            f"{path}: unknown key '{next(iter(content))}'; beside 'nominal' go 'effects', 'covariance' and 'noise'."
        )
    nominal = content if nominal is None else _mapping(nominal, f"{path}: key 'nominal'")
    if "tyre" in nominal:
        nominal = _with_tyre(nominal, path)
    for key in BESIDE:
        if key in nominal:
            raise BadInput(f"{path}: key 'nominal' holds '{key}'; move it out of 'nominal'.")
    vehicle = from_dict(VehicleConfig, nominal, str(path))
    where = f"{path}: key 'effects'"
    effects = _mapping({} if effects is None else effects, where)
    estimates = _effect_parameters(effects, vehicle, where)
    in_file = [one.parameter in effects[one.effect] for one in estimates]
    matrix = () if covariance is None else _covariance(covariance, estimates, in_file, f"{path}: key 'covariance'")
    at = f"{path}: key 'noise'"
    estimated_noise = None if noise is None else from_dict(EstimatedNoise, _mapping(noise, at), at)
    vehicle = dataclasses.replace(vehicle, effects=estimates, covariance=matrix, noise=estimated_noise)
    return vehicle if combined_slip is None else vehicle.with_combined_slip(combined_slip)


def write_vehicle(path: str | Path, vehicle: VehicleConfig) -> None:
    """Write a vehicle as `load_vehicle` reads it: nominal parameters, effects, their covariance, and noise, SI."""
    nominal = {key: value for key, value in dataclasses.asdict(vehicle).items() if key not in BESIDE}
    effects: dict[str, dict[str, Any]] = {}
    for one in vehicle.effects:
        effects.setdefault(one.effect, {})[one.parameter] = {"value": one.value, "ci95_half": one.ci95_half}
    content = {"nominal": nominal, "effects": effects}
    if vehicle.covariance:
        matrix = [list(row) for row in vehicle.covariance]
        content["covariance"] = {"parameters": [one.name for one in vehicle.effects], "matrix": matrix}
    if vehicle.noise:
        content["noise"] = dataclasses.asdict(vehicle.noise)
    text = yaml.safe_dump(content, sort_keys=False)
    write_text(Path(path), text)


def _with_tyre(nominal: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the keys with mu, B and C of the tyre property file that `tyre` names, at the static load of a wheel."""
    tyre, mass = nominal["tyre"], nominal.get("m")
    if not isinstance(tyre, str):
        raise BadInput(f"{path}: key 'tyre' is {shown(tyre)}; it needs the name of a .tir file.")
    if double := [key for key in ("mu", "B", "C") if key in nominal]:
        raise BadInput(f"{path}: keys 'tyre' and '{double[0]}' say the same; keep one of them.")
    if isinstance(mass, bool) or not isinstance(mass, int | float) or not 0 < mass < math.inf:
        raise BadInput(f"{path}: key 'm' is {shown(mass)}; it must be positive, for the load of the tyre.")
    values = nominal_tyre(read_tir(path.parent / tyre), mass * G / 4)
    return {key: value for key, value in nominal.items() if key != "tyre"} | dict(
        zip("mu B C".split(), values, strict=True)
    )


def _mapping(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise BadInput(f"{where} is {shown(value)}; it needs keys of its own.")
    return value


def with_effects(vehicle: VehicleConfig, effects: Mapping[str, Mapping[str, float]]) -> VehicleConfig:
    """Return `vehicle` with these effects (effect -> parameter -> value, SI) beside its own, whose values they replace.

    The covariance of its effects is dropped. Raises `BadInput` for unknown names and for values out of bounds.
    """
    new = _effect_parameters({name: dict(values) for name, values in effects.items()}, vehicle, "effects")
    own = [one for one in vehicle.effects if one.effect not in effects]
    order = list(EFFECTS)
    parameters = sorted((*own, *new), key=lambda one: order.index(one.effect))
    return dataclasses.replace(vehicle, effects=tuple(parameters), covariance=())


def _effect_parameters(written: dict[str, Any], vehicle: VehicleConfig, where: str) -> tuple[EffectParameterValue, ...]:
    """Return every parameter of the effects `written`, in the catalogue's order."""
    try:
        effects = effects_by_name(tuple(map(str, written)))
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None
    estimates = []
    for effect in effects:
        values, names = _mapping(written[effect.name], f"{where}: {effect.name}"), [p.name for p in effect.parameters]
        for name in values:
            if name not in names:
                raise BadInput(f"{where}: {effect.name} has no parameter '{name}'; it has {', '.join(names)}.")
        for p in effect.parameters:
            if p.name not in values and not p.optional:
                raise BadInput(f"{where}: {effect.name} lacks '{p.name}'; add it, 0 is neutral.")
            value = _value(values.get(p.name, 0.0), p, vehicle, f"{where}: {effect.name}.{p.name}")
            estimates.append(EffectParameterValue(effect.name, p.name, *value))
    return tuple(estimates)


def _value(written: Any, parameter: Parameter, vehicle: VehicleConfig, where: str) -> tuple[float, float | None]:
    """Return the value and half-width of its interval, from a number or {value, ci95_half}."""
    parts = written if isinstance(written, dict) else {"value": written}
    if "value" not in parts or parts.keys() - {"value", "ci95_half"}:
        raise BadInput(f"{where} holds {', '.join(map(str, parts))}; it takes 'value' and, if known, 'ci95_half'.")
    value, half = (None if parts.get(key) is None else _number(parts[key], where) for key in ("value", "ci95_half"))
    lower, upper = parameter.bounds(vehicle)
    if value is None or not lower * (1 + ROUNDING) <= value <= upper * (1 + ROUNDING):
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        raise BadInput(f"{where} is {value}; the value lies in {lower:.4g}..{upper:.4g}{unit}.")
    return value, half


def _number(written: Any, where: str) -> float:
    number = written_float(written)
    if number is None or not math.isfinite(number):
        raise BadInput(f"{where} is {shown(written)}; it needs a number.")
    return number


def _covariance(
    written: Any, estimates: tuple[EffectParameterValue, ...], in_file: list[bool], where: str
) -> tuple[tuple[float, ...], ...]:
    """Check the covariance of the parameters that are `in_file`; return it with zeros for all other `estimates`."""
    parts = _mapping(written, where)
    names = [one.name for one, there in zip(estimates, in_file, strict=True) if there]
    if parts.keys() != {"parameters", "matrix"} or parts["parameters"] != names:
        raise BadInput(f"{where} needs 'matrix', and 'parameters': [{', '.join(names)}], in this order.")
    rows = parts["matrix"]
    square = isinstance(rows, list) and all(isinstance(row, list) and len(row) == len(rows) for row in rows)
    if not square or len(rows) != len(names):
        raise BadInput(f"{where}: 'matrix' needs {len(names)} rows of {len(names)} numbers.")
    matrix = tuple(tuple(_number(value, f"{where}: 'matrix'") for value in row) for row in rows)
    spread = [math.sqrt(max(matrix[i][i], 0.0)) for i in range(len(matrix))]
    for i, row in enumerate(matrix):
        for j, value in enumerate(row):
            size = spread[i] * spread[j]
            if abs(value) > (1 + SYMMETRIC) * size or abs(value - matrix[j][i]) > SYMMETRIC * size:
                raise BadInput(f"{where}: 'matrix' is no covariance in row {i + 1}, column {j + 1}.")
    full = np.zeros((len(estimates), len(estimates)))
    full[np.ix_(in_file, in_file)] = np.asarray(matrix)
    return tuple(map(tuple, full.tolist()))
