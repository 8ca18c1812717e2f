"""Map of a car's steady states over speed and yaw rate: `python -m experiments.equilibria` (`--help`: options)."""

from pathlib import Path
from typing import Annotated

import tyro

from driftjax.equilibrium.map import MapConfig, write_map


def draw_map(options: Annotated[MapConfig, tyro.conf.arg(name="")], out: Path = Path("runs/equilibria")) -> None:
    """Write equilibria.png and equilibria.csv to the folder `out`, and print the figures of the map."""
    for name, value in write_map(options, out).items():
        print(f"{name:32s} {value:.6g}")


if __name__ == "__main__":
    tyro.cli(draw_map, prog="python -m experiments.equilibria")
