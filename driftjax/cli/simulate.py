"""`driftjax simulate`: a log of a car with known effects, and the truth beside it."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from driftjax.cli.console import default_out, early_flags, log_flags, parse, run_in
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
class SimulateOptions:
    """Drive manoeuvres on a car with any effects: log.csv in the log format, and its truth.yaml."""

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
    """Drive and write."""
    early, _ = early_flags(argv, "config")
    flags = parse(SimulateOptions, argv, "driftjax simulate", defaults(early["config"]))
    vehicle = load_vehicle(flags.vehicle)
    try:
        vehicle = vehicle.with_combined_slip(flags.combined_slip)
    except BadInput as error:
        raise BadInput(f"flags: {error}") from None
    theta = effect_strengths(vehicle, flags.effects)
    out = flags.out or default_out("simulate", vehicle.name)
    for name in FILES:
        if (out / name).exists():
            raise BadInput(f"{out / name}: exists already; give another folder (--out).")
    options = {key: to_dict(flags)[key] for key in OWN} | to_dict(flags.options)
    folder = RunFolder.create(out, options, "simulate")
    print(f"driving {len(flags.options.manoeuvres)} runs of {flags.options.duration:g} s on {vehicle.name}",
          flush=True)  # fmt: skip
    return run_in(folder, lambda: work(vehicle, theta, flags, folder))


def defaults(file: str | None) -> SimulateOptions:
    """Return the options of the verb updated by the YAML `file`."""
    written = read_yaml(Path(file)) if file else {}
    own = {key: written.pop(key) for key in OWN if key in written}
    options = from_dict(Campaign, written, file or "defaults")
    return dataclasses.replace(from_dict(SimulateOptions, own, file or "defaults"), options=options)


def work(vehicle: VehicleConfig, theta: np.ndarray, flags: SimulateOptions, folder: RunFolder) -> int:
    """Write log and truth into `folder`; returns 1 where no run is left."""
    runs, truth = record_runs(vehicle, theta, flags.options)
    write_truth(folder.path / "truth.yaml", truth, str(flags.vehicle), vehicle.combined_slip, flags.options)
    for name in truth.left_out:
        print(f"{name}: the car spun or came to a stop in every draw; the run was left out.")
    if not runs:
        print("driftjax simulate: the car spun or came to a stop in every run; weaken the effects or the noise.",
              file=sys.stderr)  # fmt: skip
        return 1
    write_log(folder.path / "log.csv", runs)
    print(f"log: {folder.path / 'log.csv'}, {len(runs)} runs\ntruth: {folder.path / 'truth.yaml'}")
    again = log_flags([folder.path / "log.csv"], None, flags.vehicle)
    print(f"next: `driftjax diagnose {again} --combined-slip {vehicle.combined_slip:g}` "
          "says what that car lacks in this log.")  # fmt: skip
    return 0
