"""`driftjax diagnose`: what measured logs say the model gets wrong, and what mending it gains."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro
import yaml

from driftjax.cli.console import default_out, progress, typed, within
from driftjax.cli.simulate import drive_again
from driftjax.core import BadInput, write_atomically
from driftjax.data import Log, RunFolder, load_columns, read_log
from driftjax.data.columns import MEASURED
from driftjax.diagnose.diagnosis import DiagnoseConfig, Diagnosis, diagnose, extended, gain_json, to_json
from driftjax.diagnose.verdict import Judgement
from driftjax.vehicle import VehicleConfig, load_vehicle

STEPS = ("noise and nominal car", "naming", "gain", "done")


@dataclasses.dataclass(frozen=True)
class Diagnose:
    """Name what a simulation gets wrong, from measured logs: diagnosis.json, extended.yaml and a table of the gain."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """CSV or Parquet files in the log format (t, V, beta, r, delta, Fxr and, where known, run, psi, s)."""
    options: Annotated[DiagnoseConfig, tyro.conf.arg(name="")] = DiagnoseConfig()
    vehicle: Path = Path("sedan")
    """Nominal car: a shipped name or a vehicle YAML."""
    combined_slip: float | None = None
    """Friction ellipse of the nominal car, 0 none (as published), 1 a circle; left out: the vehicle's own [-]."""
    columns: str | None = None
    """Column map of foreign logs: a shipped name or a YAML; left out: the log format."""
    drive: Path | None = None
    """truth.yaml of a simulated car: the manoeuvre proposed is driven on it, and the diagnosis made again with that run
    in the folder `next`."""
    out: Path | None = None
    """Output folder; runs/diagnose-CAR-TIME where left out."""


def run(argv: list[str]) -> int:
    """Read, name, measure, tell."""
    asked = typed(Diagnose, argv, "driftjax diagnose")
    vehicle = load_vehicle(asked.vehicle)
    if asked.combined_slip is not None:
        vehicle = vehicle.with_slip(asked.combined_slip)
    if vehicle.effects:
        raise BadInput(f"{asked.vehicle}: key 'effects': a diagnosis starts from a nominal car; leave the effects out.")
    log = read_log(asked.logs, load_columns(asked.columns) if asked.columns else None)
    options = {"vehicle": dataclasses.asdict(vehicle), "logs": [str(path) for path in asked.logs]}
    options |= {"columns": asked.columns, "options": dataclasses.asdict(asked.options)}
    folder = RunFolder.create(asked.out or default_out("diagnose", vehicle.name), options, "diagnose")

    def both() -> int:
        found = work(vehicle, log, asked.options, folder)
        if asked.drive and isinstance(found, Diagnosis) and found.proposal:
            more = folder.path / "next.csv"
            drive_again(asked.drive, found.proposal.manoeuvre, more)
            again = RunFolder.create(
                folder.path / "next", options | {"logs": [*options["logs"], str(more)]}, "diagnose"
            )
            work(vehicle, read_log((*asked.logs, more)), asked.options, again)
        return 0

    return within(folder, both)


def work(vehicle: VehicleConfig, log: Log, config: DiagnoseConfig, folder: RunFolder) -> Diagnosis | Judgement:
    """The diagnosis into `folder` and onto the screen."""
    for note in log.notes:
        print(f"note: {note}")
    with progress() as report:
        found = diagnose(vehicle, log, config, lambda text: report(text, STEPS.index(text), len(STEPS) - 1))
        report("done", len(STEPS) - 1, len(STEPS) - 1)
    if isinstance(found, Diagnosis):
        content, judgement = to_json(found, log), found.judgement
        text = yaml.safe_dump(extended(found), sort_keys=False)
        write_atomically(folder.path / "extended.yaml", lambda path: path.write_text(text, encoding="utf-8"))
    else:
        content, judgement = _bare(found.sentence, str(found.verdict), log, config), found
    folder.write_json("diagnosis", content)
    print(f"\n{judgement.verdict}: {judgement.sentence}\n")
    if isinstance(found, Diagnosis) and found.proposal:
        print(found.proposal.sentence + "\n")
    if isinstance(found, Diagnosis):
        print(gain_table(found))
    print(f"diagnosis: {folder.path}")
    return found


def _bare(sentence: str, verdict: str, log: Log, config: DiagnoseConfig) -> dict[str, Any]:
    """`diagnosis.json` of data that say nothing."""
    data = {"sha256": log.sha256, "rows": log.rows, "notes": list(log.notes), "noise_sigma": {}}
    return {
        "schema": 1, "verdict": verdict, "sentence": sentence, "causes": [],
        "unexplained": {"p_value": None, "channel": None, "drivers": []}, "gain": gain_json(None),
        "next_manoeuvre": None, "data": data, "seed": config.seed,
    }  # fmt: skip


def gain_table(found: Diagnosis) -> str:
    """Open-loop errors on the runs held out, per model and horizon, and the share of the explainable error removed."""
    gain = gain_json(found.gain)
    if not gain["held_out_runs"]:
        return "gain: not measured, for want of runs to hold out.\n"
    lines = [f"open-loop error (RMS) on the runs held out: {', '.join(gain['held_out_runs'])}"]
    lines += [f"{'model':12}{'after [s]':>10}{'V [m/s]':>10}{'beta [rad]':>12}{'r [rad/s]':>11}   explainable removed"]
    for name, channels in gain["rmse"].items():
        for i, horizon in enumerate(gain["horizons_s"]):
            values = "".join(f"{channels[c][i]:{w}.4f}" for c, w in zip(MEASURED, (10, 12, 11), strict=True))
            share = ""
            if horizon == 1.0 and name in gain["skill"]:
                low, high = gain["ci95"][name]
                share = f"   {gain['skill'][name]:.2f} [{low:.2f}, {high:.2f}]"
            lines.append(f"{name:12}{horizon:10.3g}{values}{share}")
    return "\n".join(lines) + "\n"
