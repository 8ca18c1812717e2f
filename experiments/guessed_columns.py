"""Count the channels of known logs that `guess_columns` places rightly: as they are, in other units, with other signs.

python -m experiments.guessed_columns ../shared/data/*/*.csv

Files are recognised by name. Of each CSV of a real drive there are two more versions: `units` (degrees, km/h and g,
which no name states) and `signs` (yaw rate, steering and sideways velocity to the right, heading as a compass).
"""

import csv
import dataclasses
import tempfile
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import tyro

import driftjax as dj

DEG, KMH, G = np.pi / 180, 1 / 3.6, 9.80665
ColumnTruth = dict[str, tuple[str, float]]


def same(*names: str) -> ColumnTruth:
    """Columns in the units of the log format: `channel=column`."""
    return {channel: (column, 1.0) for channel, _, column in (name.partition("=") for name in names)}


DART = same("t=t_s", "vx=vx_mps", "vy=vy_mps", "r=yaw_rate_radps", "psi=psi_rad", "x=x_m", "y=y_m", "ax=ax_mps2",
            "ay=ay_mps2", "delta=delta_map_rad")  # fmt: skip
FERRARI = same("t=t_s", "vx=vx_mps", "vy=vy_mps", "r=yaw_rate_radps", "psi=psi_int_rad", "ax=ax_mps2", "ay=ay_mps2",
               "delta=delta_rad")  # fmt: skip
GENESIS = same("t=t_s", "vx=vx_mps", "vy=vy_mps", "r=yaw_rate_radps", "psi=psi_rad", "x=x_m", "y=y_m",
               "delta=delta_rad", "ax=a_long_mps2", "ay=a_lat_mps2")  # fmt: skip
MESSAGES = same("t=time", "vx=/odom.twist.twist.linear.x", "vy=/odom.twist.twist.linear.y", "r=/imu.angular_velocity.z",
                "psi=/odom.pose.pose.orientation.yaw", "x=/odom.pose.pose.position.x", "ay=/imu.linear_acceleration.y",
                "delta=/command.data[0]", "Fxr=/command.data[1]")  # fmt: skip
# what each log holds, by file name; s and e may be placed or not
KNOWN: dict[str, ColumnTruth] = {
    "grip.csv": DART, "low_grip.csv": DART, "ramps.csv": DART, "steer_id.csv": DART, "targa66*.csv": FERRARI,
    "cpg*.csv": GENESIS, "dart*.csv": DART, "ferrari.csv": FERRARI, "genesis.csv": GENESIS,
    "*.bag": MESSAGES, "ros2*": MESSAGES, "*.mcap": MESSAGES,
    "log.mf4": same("t=time", "vx=vx", "vy=vy", "psi=psi", "x=x", "r=r", "ay=ay", "delta=delta", "Fxr=force"),
    "lap.ld": {**same("t=time", "Fxr=Drive Force"), "V": ("Ground Speed", KMH), "beta": ("Slip Angle", DEG),
               "r": ("Gyro Yaw Velocity", DEG), "ay": ("G Force Lat", G), "delta": ("Steered Angle", DEG),
               "latitude": ("GPS Latitude", DEG), "longitude": ("GPS Longitude", DEG)},
    "lap.vbo": {**same("t=time", "r=yaw", "Fxr=force"), "V": ("velocity", KMH), "beta": ("slip", DEG),
                "delta": ("steer", DEG), "latitude": ("lat", DEG), "longitude": ("long", DEG)},
    "lap.erg": same("t=time", "V=Car.v", "beta=Car.SideSlipAngle", "r=Car.YawRate", "delta=VC.Steer.Ang", "Fxr=Car.Fx",
                    "x=Car.Fr1.tx"),
    "lap.xrk": {**same("t=time", "Fxr=Force"), "V": ("GPS Speed", 1.0), "beta": ("Slip", DEG), "r": ("Yaw Rate", DEG),
                "ay": ("LatAcc", G), "delta": ("Steer", DEG),
                "latitude": ("GPS Latitude", DEG), "longitude": ("GPS Longitude", DEG)},
    # rbalexan/me-227, rbalexan/vehicle-state-estimation and rkurdyumov/ME227 on GitHub
    "niki_dlc.mat": same("t=t_.0", "vx=ux_mps_.0", "vy=uy_mps_.0", "r=r_radps_.0", "ay=ay_mps2_.0",
                         "delta=delta_rad_.0"),
    "niki_raw.mat": same("t=t_10ms", "vx=OxTSData.vxCG_mps", "vy=OxTSData.vyCG_mps", "r=OxTSData.yawRate_radps",
                         "psi=OxTSData.yawAngle_rad", "x=OxTSData.posE_m", "y=OxTSData.posN_m", "ax=OxTSData.axCG_mps2",
                         "ay=OxTSData.ayCG_mps2", "Fxr=HLlongitudinal.FxCmd_N", "s=mapMatch.s_m", "e=mapMatch.e_m",
                         "delta=vehicleData.roadWheelAngle_rad"),
    "niki_proj.mat": same("t=t", "vx=ux_mps", "vy=uy_mps", "r=r_radps", "ax=ax_mps2", "ay=ay_mps2", "delta=delta_rad",
                          "x=east_m", "y=north_m", "Fxr=fxcmd_N"),
    "aa273.mat": same("t=t", "vx=Ux", "vy=Uy", "r=r", "delta=delta", "Fxr=Fx"),
    "p1.mat": same("t=time_s", "V=Speed_mps", "beta=Sideslip_rad", "r=YawRate_radps", "ay=LateralAcceleration_mps2",
                   "delta=deltaRoadwheels_rad"),
    # uwsbel/sbel-reproducibility, simulated
    "hmmwv.csv": same("t=time", "vx=vx", "vy=vy", "x=x", "y=y", "ax=ax", "ay=ay", "psi=yaw", "r=yaw_rate",
                      "delta=Steering_input"),
}  # fmt: skip
UNITS = {"_radps2": ("_radps2", 1.0), "_radps": ("", 1 / DEG), "_rad": ("", 1 / DEG), "_mps2": ("", 1 / G),
         "_mps": ("", 1 / KMH), "_m": ("", 1.0), "_s": ("", 1.0)}  # fmt: skip
BACK = {"angle": DEG, "speed": KMH, "acceleration": G}
SHARE_DIMENSION = {"angle": ("r", "psi", "beta", "delta"), "speed": ("vx", "vy", "V"), "acceleration": ("ax", "ay")}
DIMENSION = {channel: family for family, channels in SHARE_DIMENSION.items() for channel in channels}
MADE_UP = (
    "hmmwv.csv",
    "dart.csv",
    "dart_steer_id.csv",
    "ferrari.csv",
    "genesis.csv",
)  # of the tests; no car moves like this
FREE = ("s", "e")
SIGN_CHANGES = ("r", "vy", "delta", "psi")


@dataclasses.dataclass(frozen=True)
class Config:
    """Logs whose channels are known."""

    logs: tyro.conf.Positional[tuple[Path, ...]]
    """Files or bags whose names are among those of the script."""
    rows: int = 60000
    """Rows of a CSV that the changed versions have at most."""


def known(path: Path) -> ColumnTruth:
    """What the log `path` holds."""
    truths = [truth for pattern, truth in KNOWN.items() if fnmatchcase(path.name, pattern)]
    if not truths:
        raise dj.BadInput(f"{path}: is none of the logs whose channels are known; add it to KNOWN.")
    return truths[0]


def in_other_units(path: Path, truth: ColumnTruth, out: Path, rows: int) -> ColumnTruth:
    """Write the log with names that state no unit, in degrees, km/h and g; return what it holds."""
    names, cells = read_rows(path, rows)
    renamed = {}
    for k, name in enumerate(names):
        suffix = next((one for one in UNITS if name.endswith(one)), None)
        plain, factor = UNITS[suffix] if suffix else ("", 1.0)
        renamed[name] = name.removesuffix(suffix) + plain if suffix else name
        scale(cells, k, factor)
    write_rows(out, [renamed[name] for name in names], cells)
    return {channel: (renamed[column], BACK.get(DIMENSION.get(channel, ""), 1.0))
            for channel, (column, _) in truth.items()}  # fmt: skip


def in_other_signs(path: Path, truth: ColumnTruth, out: Path, rows: int) -> ColumnTruth:
    """Write the log with signs to the right and a compass heading; return what it holds."""
    names, cells = read_rows(path, rows)
    there = {channel: one for channel, one in truth.items() if channel in SIGN_CHANGES}
    if not {"x", "y"} <= set(truth):
        there.pop("psi", None)  # without a position nothing tells a mirror image from the car
    for channel, (column, _) in there.items():
        scale(cells, names.index(column), -1.0, np.pi / 2 if channel == "psi" else 0.0)
    write_rows(out, names, cells)
    return truth | {channel: (column, -factor) for channel, (column, factor) in there.items()}


def scale(cells: list[list[str]], k: int, factor: float, offset: float = 0.0) -> None:
    """Change the numbers of column `k` in place."""
    if factor == 1.0 and not offset:
        return
    for row in cells:
        if row[k]:
            row[k] = f"{factor * float(row[k]) + offset:.9g}"


def read_rows(path: Path, rows: int) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of a CSV."""
    with path.open(newline="") as stream:
        names, *cells = csv.reader(stream)
    return names, cells[:rows]


def write_rows(path: Path, names: list[str], cells: list[list[str]]) -> None:
    """Write a CSV."""
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([names, *cells])


def count(path: Path, truth: ColumnTruth) -> tuple[int, int, list[str]]:
    """Return the number of right channels, of all that count, and the wrong ones.

    Those count that the log holds, and those that are placed without being there.
    """
    try:
        placed = {one.channel: one for one in dj.guess_columns(path).channels}
    except dj.BadInput as error:
        return 0, len(truth), [str(error)]
    right, wrong = 0, []
    for channel, (column, factor) in truth.items():
        one = placed.pop(channel, None)
        if one is not None and one.column == column and abs(one.factor / factor - 1) < 0.01:
            right += 1
        else:
            got = "nothing" if one is None else f"{one.factor:g} {one.column} ({100 * one.certainty:.0f} %)"
            wrong.append(f"{channel}: {got}, not {factor:g} {column}")
    extra = [one for channel, one in placed.items() if channel not in FREE]
    wrong += [f"{one.channel}: {one.column} ({100 * one.certainty:.0f} %), not there" for one in extra]
    return right, len(truth) + len(extra), wrong


def run(config: Config) -> None:
    """Print a row per log and version, and the share of each version."""
    totals: dict[str, list[int]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for path in config.logs:
            truth = known(path)
            versions = [("as it is", path, truth)]
            if path.suffix == ".csv" and path.name not in MADE_UP:
                for name, change in (("units", in_other_units), ("signs", in_other_signs)):
                    out = Path(folder) / f"{path.stem}-{name}.csv"
                    versions.append((name, out, change(path, truth, out, config.rows)))
            for name, file, holds in versions:
                right, num, wrong = count(file, holds)
                total = totals.setdefault(name, [0, 0])
                total[0], total[1] = total[0] + right, total[1] + num
                print(f"{path.name:28} {name:9} {right:3d} of {num:3d}  {'; '.join(wrong)}", flush=True)
    for name, (right, num) in totals.items():
        print(f"{'all':28} {name:9} {right:3d} of {num:3d}  {100 * right / num:.1f} %")


if __name__ == "__main__":
    run(tyro.cli(Config))
