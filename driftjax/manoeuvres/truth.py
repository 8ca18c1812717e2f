"""truth.yaml of a simulated log: effects of the car, noise and manoeuvres."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from driftjax.core import BadInput, from_dict, read_yaml, shown, write_text
from driftjax.core.config import to_dict
from driftjax.logs import write_log
from driftjax.manoeuvres.campaign import LATER, Campaign, Truth, record_runs
from driftjax.vehicle import VehicleConfig, load_vehicle
from driftjax.vehicle.effect import EFFECTS, effects_by_name


def effect_strengths(vehicle: VehicleConfig, words: Sequence[str] = ()) -> Float[np.ndarray, "K"]:
    """Return the strengths of all K parameters of the catalogue, in typical sizes, for `record_runs`.

    They are those of the effects of `vehicle` itself, changed by `words`: `name.parameter=value` (SI) and `name=sizes`,
    such as `yaw_inertia=2`; the last one counts.
    Raises `BadInput` for an unknown effect or parameter, and for a value outside its bounds.
    """
    parameters = [(effect.name, parameter) for effect in EFFECTS.values() for parameter in effect.parameters]
    theta = np.zeros(len(parameters))
    for word in (*(f"{one.name}={one.value!r}" for one in vehicle.effects), *words):
        target, _, number = word.partition("=")
        name, _, which = target.partition(".")
        (effect,) = effects_by_name((name,))
        known = ", ".join(one.name for one in effect.parameters)
        if which and which not in known.split(", "):
            raise BadInput(f"effect '{word}': {name} has no parameter '{which}'; it has {known}.")
        value = _number(number, word)
        for i, (owner, parameter) in enumerate(parameters):
            if owner == name and (not which or parameter.name == which):
                scale = parameter.scale(vehicle) if which else 1.0
                lower, upper = parameter.bounds(vehicle) if which else (parameter.lower, parameter.upper)
                if not lower <= value <= upper:
                    unit = parameter.suffix if which else " typical sizes"
                    raise BadInput(f"effect '{word}': the value lies in {lower:.4g}..{upper:.4g}{unit}.")
                theta[i] = value / scale
    return theta


def _number(text: str, word: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadInput(f"effect '{word}': there is no number; write name.parameter=value in SI, or name=typical sizes.")
    return value


def write_truth(path: str | Path, truth: Truth, vehicle: str, combined_slip: float, campaign: Campaign) -> None:
    """Write the truth of the runs of a `campaign` (see `record_runs`) as YAML, SI, for `Diagnosis.drive_proposal`.

    `vehicle` names the base car, a shipped one or a file, and `combined_slip` [-] its friction ellipse.
    """
    content: dict[str, Any] = {
        "vehicle": vehicle, "combined_slip": combined_slip, "effects": truth.effects, "noise": truth.noise,
        "process_noise": truth.process_noise, "seed": campaign.seed, "campaign": to_dict(campaign),
        "left_out": list(truth.left_out),
    }  # fmt: skip
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    write_text(Path(path), text)


def read_truth(path: Path) -> tuple[VehicleConfig, Float[np.ndarray, "K"], Campaign]:
    """Read the car without its effects, their strengths (whole catalogue, in typical sizes), and the campaign."""
    content = read_yaml(path)
    missing = [key for key in ("vehicle", "combined_slip", "effects", "campaign") if key not in content]
    if missing:
        raise BadInput(f"{path}: key '{missing[0]}' is missing; give the truth.yaml that `driftjax simulate` wrote.")
    effects = content["effects"]
    if not (isinstance(effects, dict) and all(isinstance(values, dict) for values in effects.values())):
        raise BadInput(f"{path}: key 'effects' is {shown(effects)}; it needs effects with their parameters.")
    vehicle = load_vehicle(content["vehicle"]).with_combined_slip(content["combined_slip"])
    vehicle = dataclasses.replace(vehicle, effects=(), covariance=())  # `effects` of the file holds theirs too
    words = [f"{name}.{key}={value!r}" for name, values in effects.items() for key, value in values.items()]
    return vehicle, effect_strengths(vehicle, tuple(words)), from_dict(Campaign, content["campaign"], str(path))


def drive_again(truth: Path, manoeuvre: str, log: Path) -> None:
    """Drive one more run of `manoeuvre` on the car that `truth` describes, with a new seed, and write it to `log`."""
    vehicle, theta, before = read_truth(truth)
    campaign = dataclasses.replace(before, manoeuvres=(manoeuvre,), seed=before.seed + LATER)
    runs, _ = record_runs(vehicle, theta, campaign)
    if not runs:
        raise BadInput(f"{truth}: the car spun or came to a stop in every draw of '{manoeuvre}'.")
    write_log(log, runs)
