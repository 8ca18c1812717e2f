"""Write a car in another tool's format, and report the effects that it cannot represent."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from driftjax.core import BadInput
from driftjax.environment import require_float64
from driftjax.export.casadi_car import CASADI
from driftjax.export.loss import Loss, loss
from driftjax.export.racing import GYM, RACE_STACK, TUM
from driftjax.export.simulators import AUTOWARE, COMMONROAD, OPEN_CAR_DYNAMICS
from driftjax.export.target import Format, TargetOptions, restrict_effects
from driftjax.logs import Log
from driftjax.store.files import write_json
from driftjax.vehicle import VehicleConfig
from driftjax.vehicle.effect import EFFECTS

FORMATS: dict[str, Format] = {
    "race_stack": RACE_STACK, "tum": TUM, "f1tenth_gym": GYM, "commonroad": COMMONROAD, "autoware": AUTOWARE,
    "open_car_dynamics": OPEN_CAR_DYNAMICS, "casadi": CASADI,
}  # fmt: skip


@dataclass(frozen=True)
class Export:
    """Files of a car in another tool's format, and the effects that they lack."""

    to: str
    """Name of the format."""
    title: str
    """What it is."""
    files: tuple[Path, ...]
    """Files that were written."""
    represented: tuple[str, ...]
    """Effects of the car that the files hold."""
    lost: tuple[str, ...]
    """Effects of the car that the format cannot hold."""
    notes: tuple[str, ...]
    """How the target's model differs from any car of this package, and what was chosen for it."""
    loss: Loss | None
    """Change of open-loop predictions by the lost effects; None where nothing is lost or nothing is predicted."""

    def to_json(self) -> dict[str, Any]:
        """Return the content of export.json."""
        return {
            "to": self.to, "title": self.title, "files": [path.name for path in self.files],
            "held": list(self.represented),
            "lost": {name: EFFECTS[name].sentence for name in self.lost}, "notes": list(self.notes),
            "loss": self.loss._asdict() if self.loss else None,
        }  # fmt: skip

    def __str__(self) -> str:
        """Return the report that `driftjax export` prints."""
        lines = [self.title, *(f"  {path}" for path in self.files)]
        lines += [f"held: {', '.join(self.represented)}"] * bool(self.represented)
        lines += [f"lost: {name} ({EFFECTS[name].sentence})" for name in self.lost] or ["lost: no effect of this car"]
        lines += [f"note: {note}." for note in self.notes]
        return "\n".join([*lines, *([_sentence(self.loss)] if self.loss else [])])


def require_format(to: str) -> None:
    """Raise `BadInput` for an unknown format."""
    if to not in FORMATS:
        raise BadInput(f"there is no format '{to}' (--to); choose one of {', '.join(FORMATS)}.")


def export_car(
    vehicle: VehicleConfig, to: str, folder: str | Path, *, log: Log | None = None, top_speed: float | None = None,
    dt: float = 0.02,
) -> Export:  # fmt: skip
    """Write `vehicle` with its effects into `folder` in the format `to`, and the loss of that format in export.json.

    `to` is race_stack, tum, f1tenth_gym, commonroad, autoware, open_car_dynamics or casadi. The loss is how much worse
    the car predicts without the lost effects: on `log`, or else in a standard manoeuvre. `top_speed` [m/s] bounds
    tables and limits (left out: 9 sqrt(g L)), `dt` [s] is the sample time of the CasADi step. Raises `BadInput` for an
    unknown format, for a log that lacks what the loss is measured with, and for a folder that cannot be written.
    """
    require_float64()
    require_format(to)
    for name, value in (("top_speed", top_speed), ("dt", dt)):
        if value is not None and not 0 < value < float("inf"):
            raise BadInput(f"{name} is {value}; it must be positive.")
    target, folder = FORMATS[to], Path(folder)
    reduced = restrict_effects(vehicle, target.holds, TargetOptions(top_speed, dt))
    named = [name for name in EFFECTS if any(one.effect == name for one in vehicle.effects)]
    lost = tuple(name for name in named if name not in target.holds)
    of_lost = loss(vehicle, reduced.vehicle, log) if lost and target.predicts else None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        files = target.write(reduced, folder)
    except OSError as error:
        raise BadInput(f"{folder}: cannot be written ({error.strerror}); give another folder (--out).") from None
    export = Export(
        to, target.title, tuple(folder / name for name in files), tuple(n for n in named if n not in lost), lost,
        target.notes, of_lost,
    )  # fmt: skip
    write_json(folder / "export.json", export.to_json())
    return export


def _sentence(loss: Loss) -> str:
    V, beta, r = loss.without_them
    if loss.with_them is None:
        apart = f"{V:.3g} m/s, {beta:.3g} rad and {r:.3g} rad/s RMS"
        return f"loss: without the lost effects the car is off by {apart} in {loss.horizon_s:.2g} s of the {loss.of}."
    pairs = zip(loss.with_them, loss.without_them, ("m/s", "rad", "rad/s"), strict=True)
    words = ", ".join(f"{b:.3g} instead of {a:.3g} {unit}" for a, b, unit in pairs)
    return f"loss: without the lost effects, predictions {loss.horizon_s:.2g} s ahead on the log err by {words} RMS."
