"""`driftjax simulate`: a log of a car with known effects, and the truth beside it."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from driftjax.cli.console import default_out, peek, typed, within
from driftjax.core import BadInput, from_dict, read_yaml
from driftjax.core.config import to_dict
from driftjax.logs import write_log
from driftjax.manoeuvres.campaign import Campaign, record_runs
from driftjax.manoeuvres.truth import effect_strengths, write_truth
from driftjax.store import RunFolder
from driftjax.vehicle import VehicleConfig, load_vehicle

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
        vehicle = vehicle.with_combined_slip(typed_in.combined_slip)
    except BadInput as error:
        raise BadInput(f"flags: {error}") from None
    own = tuple(f"{one.name}={one.value!r}" for one in vehicle.effects)
    theta = effect_strengths(vehicle, own + typed_in.effects)
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


def work(vehicle: VehicleConfig, theta: np.ndarray, typed_in: Simulate, folder: RunFolder) -> int:
    """Log and truth into `folder`; 1 where no run is left."""
    runs, truth = record_runs(vehicle, theta, typed_in.options)
    write_truth(folder.path / "truth.yaml", truth, str(typed_in.vehicle), vehicle.combined_slip, typed_in.options)
    for name in truth.left_out:
        print(f"{name}: the car spun or came to a stop in every draw; the run was left out.")
    if not runs:
        print("driftjax simulate: the car spun or came to a stop in every run; weaken the effects or the noise.",
              file=sys.stderr)  # fmt: skip
        return 1
    write_log(folder.path / "log.csv", runs)
    print(f"log: {folder.path / 'log.csv'}, {len(runs)} runs\ntruth: {folder.path / 'truth.yaml'}")
    return 0
