"""`driftjax equilibria`: map of a car's steady states."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from driftjax.cli.console import default_out, parse, print_notes, run_in
from driftjax.core.config import to_dict
from driftjax.equilibrium.map import MapConfig, write_map
from driftjax.store import RunFolder
from driftjax.vehicle import load_vehicle, unmodelled_effects


@dataclasses.dataclass(frozen=True)
class EquilibriaOptions:
    """Map of a car's steady states over speed and yaw rate."""

    options: Annotated[MapConfig, tyro.conf.arg(name="")] = MapConfig()
    out: Path | None = None
    """Output folder; runs/equilibria-VEHICLE-TIME where left out."""


def run(argv: list[str]) -> int:
    """Compute, draw and print the map."""
    flags = parse(EquilibriaOptions, argv, "driftjax equilibria")
    vehicle = load_vehicle(flags.options.vehicle)
    out = flags.out or default_out("equilibria", vehicle.name)
    folder = RunFolder.create(out, to_dict(flags.options), "equilibria")
    print_notes(unmodelled_effects(vehicle))

    def work() -> int:
        results = write_map(flags.options, folder.path)
        folder.write_json("results", results)
        print("\n".join(f"{name:32s} {value:.6g}" for name, value in results.items()))
        print(f"next: see {folder.path / 'equilibria.png'}; its drifts are what `driftjax learn` holds.")
        return 0

    return run_in(folder, work)
