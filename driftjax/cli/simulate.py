"""`driftjax simulate`: a log of a car with known effects, and the truth beside it."""

import dataclasses
import math
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
import yaml

from driftjax.cli.console import default_out, peek, typed, within
from driftjax.core import BadInput, from_dict, read_yaml, write_atomically
from driftjax.core.config import to_dict
from driftjax.logs import write_log
from driftjax.manoeuvres.campaign import LATER, Campaign, Truth, record_runs
from driftjax.store import RunFolder
from driftjax.vehicle import VehicleConfig, load_vehicle
from driftjax.vehicle.effect import EFFECTS, effects_named

OWN = ("vehicle", "combined_slip", "effects")  # keys beside those of Campaign
FILES = ("log.csv", "truth.yaml")


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Drive manoeuvres on a car with any effects: log.csv in the log format, and truth.yaml, which it does not tell."""

    options: Annotated[Campaign, tyro.conf.arg(name="")] = Campaign()
    vehicle: Path = Path("sedan")
    """Base car: a shipped name or a vehicle YAML."""
    combined_slip: float | None = None
    """Of the base car: 1 a friction circle; 0, as published, holds no drift within its force limits. Left out: 1, but
    an extended car keeps the one that its effects were found with [-]."""
    effects: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """An effect of the catalogue: NAME.PARAMETER=VALUE in SI units, such as load_transfer_long.h=0.5, or NAME=2 for
    all its parameters at 2 typical sizes. One per flag, added to those of the file and of an extended car; the last
    one counts."""
    config: Path | None = None
    """YAML file of options, where they differ from the defaults."""
    out: Path | None = None
    """Output folder; runs/simulate-VEHICLE-TIME where left out."""


def run(argv: list[str]) -> int:
    """Drive, write."""
    early, _ = peek(argv, "config")
    typed_in = typed(Simulate, argv, "driftjax simulate", defaults(early["config"]))
    vehicle = load_vehicle(typed_in.vehicle)
    try:
        vehicle = vehicle.with_slip(typed_in.combined_slip)
    except BadInput as error:
        raise BadInput(f"flags: {error}") from None
    own = tuple(f"{one.name}={one.value!r}" for one in vehicle.effects)
    theta = strengths(vehicle, own + typed_in.effects)
    vehicle = dataclasses.replace(vehicle, effects=(), covariance=())  # theta holds them now: one program serves all
    out = typed_in.out or default_out("simulate", vehicle.name)
    for name in FILES:
        if (out / name).exists():
            raise BadInput(f"{out / name}: exists already; give another --out.")
    options = {key: to_dict(typed_in)[key] for key in OWN} | to_dict(typed_in.options)
    folder = RunFolder.create(out, options, "simulate")
    print(f"driving {len(typed_in.options.manoeuvres)} runs of {typed_in.options.duration:g} s on {vehicle.name}",
          flush=True)  # fmt: skip
    return within(folder, lambda: work(vehicle, theta, typed_in, folder))


def defaults(file: str | None) -> Simulate:
    """The options of the YAML `file` over those of the verb."""
    written = read_yaml(Path(file)) if file else {}
    own = {key: written.pop(key) for key in OWN if key in written}
    options = from_dict(Campaign, written, file or "defaults")
    return dataclasses.replace(from_dict(Simulate, own, file or "defaults"), options=options)


def strengths(vehicle: VehicleConfig, words: tuple[str, ...]) -> np.ndarray:
    """Every parameter of the catalogue in typical sizes, from words `name.parameter=value` (SI) and `name=sizes`."""
    each = [(effect.name, parameter) for effect in EFFECTS.values() for parameter in effect.parameters]
    theta = np.zeros(len(each))
    for word in words:
        target, _, number = word.partition("=")
        name, _, which = target.partition(".")
        (effect,) = effects_named((name,))
        known = ", ".join(one.name for one in effect.parameters)
        if which and which not in known.split(", "):
            raise BadInput(f"effect '{word}': {name} has no parameter '{which}'; it has {known}.")
        value = _number(number, word)
        for i, (owner, parameter) in enumerate(each):
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


def work(vehicle: VehicleConfig, theta: np.ndarray, typed_in: Simulate, folder: RunFolder) -> int:
    """Log and truth into `folder`; 1 where no run is left."""
    runs, truth = record_runs(vehicle, theta, typed_in.options)
    text = yaml.safe_dump(described(truth, vehicle, typed_in), sort_keys=False, allow_unicode=True)
    write_atomically(folder.path / "truth.yaml", lambda p: p.write_text(text, encoding="utf-8"))
    for name in truth.left_out:
        print(f"{name}: the car spun or came to a stop in every draw; the run was left out.")
    if not runs:
        print("driftjax simulate: the car spun or came to a stop in every run; weaken the effects or the noise.",
              file=sys.stderr)  # fmt: skip
        return 1
    write_log(folder.path / "log.csv", runs)
    print(f"log: {folder.path / 'log.csv'}, {len(runs)} runs\ntruth: {folder.path / 'truth.yaml'}")
    return 0


def described(truth: Truth, vehicle: VehicleConfig, typed_in: Simulate) -> dict:
    """What truth.yaml holds, SI."""
    options = typed_in.options
    return {
        "vehicle": str(typed_in.vehicle), "combined_slip": vehicle.combined_slip,
        "effects": truth.effects, "noise": truth.noise, "process_noise": truth.process_noise,
        "seed": options.seed, "campaign": to_dict(options), "left_out": list(truth.left_out),
    }  # fmt: skip


def drive_again(truth: Path, manoeuvre: str, path: Path) -> None:
    """One more run, of `manoeuvre`, on the car that `truth` describes, into a log at `path`; with a seed of its own."""
    vehicle, theta, before = read_truth(truth)
    campaign = dataclasses.replace(before, manoeuvres=(manoeuvre,), seed=before.seed + LATER)
    runs, _ = record_runs(vehicle, theta, campaign)
    if not runs:
        raise BadInput(f"{truth}: the car spun or came to a stop in every draw of '{manoeuvre}'.")
    write_log(path, runs)


def read_truth(truth: Path) -> tuple[VehicleConfig, np.ndarray, Campaign]:
    """The car that `truth` describes, its effects (whole catalogue, in typical sizes) apart, and what was driven."""
    told = read_yaml(truth)
    missing = [key for key in ("vehicle", "combined_slip", "effects", "campaign") if key not in told]
    if missing:
        raise BadInput(f"{truth}: key '{missing[0]}' is missing; give the truth.yaml that `driftjax simulate` wrote.")
    effects = told["effects"]
    if not (isinstance(effects, dict) and all(isinstance(values, dict) for values in effects.values())):
        raise BadInput(f"{truth}: key 'effects' is {effects!r}; it needs effects with their parameters.")
    vehicle = load_vehicle(told["vehicle"]).with_slip(told["combined_slip"])
    vehicle = dataclasses.replace(vehicle, effects=(), covariance=())  # theirs are among those told
    words = [f"{name}.{key}={value!r}" for name, values in effects.items() for key, value in values.items()]
    return vehicle, strengths(vehicle, tuple(words)), from_dict(Campaign, told["campaign"], str(truth))
