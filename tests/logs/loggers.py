"""One made-up lap, written as the loggers of each format do."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

START = (49.33, 8.57)  # latitude and longitude [deg] where the lap begins
RADIUS, SPEED = 100.0, 15.0  # of the lap [m], on average [m/s]
A, E2 = 6378137.0, 6.69437999014e-3  # WGS 84


def signals(t: np.ndarray) -> dict[str, np.ndarray]:
    """A lap to the left at times `t` [s], from the southernmost point of a circle on."""
    V, course = SPEED * (1 + 0.1 * np.sin(0.5 * t)), SPEED / RADIUS * (t + 0.2 * (1 - np.cos(0.5 * t)))
    beta, along, across = 0.02 * np.sin(t), 0.05 * SPEED * np.cos(0.5 * t), V**2 / RADIUS
    return {
        "V": V,
        "beta": beta,
        "r": V / RADIUS - 0.02 * np.cos(t),
        "psi": course - beta,
        "course": course,
        "x": RADIUS * np.sin(course),
        "y": RADIUS * (1 - np.cos(course)),
        "ax": along * np.cos(beta) - across * np.sin(beta),
        "ay": along * np.sin(beta) + across * np.cos(beta),
        "delta": 2.5 / RADIUS + 0.02 * np.sin(0.5 * t),
        "Fxr": 1500 * along,
    }


def degrees(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude [deg] of metres east and north of the start, to a millimetre over some 100 m."""
    s = np.sin(np.radians(START[0]))
    across, along = A / np.sqrt(1 - E2 * s**2), A * (1 - E2) / (1 - E2 * s**2) ** 1.5
    latitude = np.radians(START[0]) + y / along
    middle = (latitude + np.radians(START[0])) / 2
    latitude -= np.tan(middle) * x**2 / (2 * across * along)  # the parallel bends away from the plane
    return np.degrees(latitude), START[1] + np.degrees(x / (across * np.cos(latitude)))


Chan = tuple[str, str, int, str, tuple[int, int, int, int], np.ndarray]


def write_ld(path: Path, until: float = 8.0) -> Path:
    """MoTeC: position in doubles at 20 Hz, the rest in floats or scaled integers at 100 and 50 Hz."""
    a, b, c = (signals(np.arange(round(until * rate)) / rate) for rate in (100, 50, 20))
    latitude, longitude = degrees(c["x"], c["y"])
    plain = (0, 1, 1, 0)  # shift, multiplier, scale, decimals
    channels: list[Chan] = [
        ("Ground Speed", "km/h", 50, "<f4", plain, 3.6 * b["V"]),
        ("Gyro Yaw Velocity", "deg/s", 100, "<i2", (0, 1, 1, 2), np.round(1e2 * np.degrees(a["r"]))),
        ("Slip Angle", "deg", 50, "<f4", plain, np.degrees(b["beta"])),
        ("G Force Lat", "G", 100, "<i4", (0, 1, 10, 3), np.round(1e4 * a["ay"] / 9.80665)),
        ("Steered Angle", "deg", 50, "<i2", (3, 2, 4, 1), np.round((np.degrees(b["delta"]) / 2 - 3) * 40)),
        ("Drive Force", "N", 50, "<f4", plain, b["Fxr"]),
        ("GPS Latitude", "deg", 20, "<f8", plain, latitude),
        ("GPS Longitude", "deg", 20, "<f8", plain, longitude),
    ]
    path.write_bytes(ld_bytes(channels))
    return path


def ld_bytes(channels: list[Chan]) -> bytes:
    first, size, kinds = 0x3448, 124, {"f": 7, "i": 3}
    at = first + size * len(channels)
    head = struct.pack("<I4xII20xI", 0x40, first, at, 0x6E2)
    descriptions, samples = b"", b""
    for k, (name, unit, rate, kind, scaling, values) in enumerate(channels):
        links = first + size * (k - 1) if k else 0, first + size * (k + 1) if k + 1 < len(channels) else 0
        code = 8 if kind == "<f8" else kinds[kind[1]]
        numbers = *links, at + len(samples), len(values), 0x2EE1 + k, code, int(kind[2]), rate, *scaling
        descriptions += struct.pack("<IIIIHHHHhhhh32s8s12s40x", *numbers, name.encode(), b"", unit.encode())
        samples += values.astype(kind).tobytes()
    return head.ljust(first, b"\0") + descriptions + samples


VBO = """File created on 01/06/2026 at 23:59:58

[header]
satellites
time
latitude
longitude
velocity kmh
heading
height
yaw
slip
steer
force

[channel units]
rad/s
deg
deg

N

[comments]
Log Rate (Hz) : 20.00

[column names]
sats time lat long velocity heading height yaw slip steer force

[data]
"""


def write_vbo(path: Path, until: float = 8.0) -> Path:
    """RaceLogic: one rate, over midnight, longitude positive to the west, heading clockwise from north."""
    t = np.arange(round(until * 20)) / 20
    y = signals(t)
    latitude, longitude = degrees(y["x"], y["y"])
    of_day = (t + 86398) % 86400
    clock = 1e4 * (of_day // 3600) + 1e2 * (of_day // 60 % 60) + of_day % 60
    heading = (90 - np.degrees(y["course"])) % 360
    rows = zip(clock, 60 * latitude, -60 * longitude, 3.6 * y["V"], heading, y["r"], np.degrees(y["beta"]),
               np.degrees(y["delta"]), y["Fxr"], strict=True)  # fmt: skip
    line = "012 {:09.2f} {:+013.7f} {:+014.7f} {:07.3f} {:06.2f} +0100.00 {:.9E} {:.9E} {:.9E} {:.9E}"
    lines = (line.format(*row) for row in rows)
    path.write_text(VBO + "\n".join(lines) + "\n", newline="\r\n")
    return path


def write_erg(path: Path, until: float = 8.0, order: str = "LittleEndian") -> Path:
    """CarMaker: one record per millisecond; a quantity with factor and offset, bytes that fill up the record."""
    t = np.arange(round(until * 100)) / 100
    y = signals(t)
    columns = {"Time": ("Double", "f8", "s", t), "Car.v": ("Float", "f4", "m/s", y["V"]),
               "Car.SideSlipAngle": ("Double", "f8", "rad", y["beta"]),
               "Car.YawRate": ("Double", "f8", "rad/s", y["r"]),
               "$none$": ("3 Bytes", "V3", "", None), "Car.Fr1.tx": ("Double", "f8", "m", y["x"]),
               "VC.Steer.Ang": ("Short", "i2", "rad", np.round((y["delta"] - 1) / 1e-4)),
               "Car.Fx": ("Double", "f8", "N", y["Fxr"])}  # fmt: skip
    sign = "<" if order == "LittleEndian" else ">"
    records = np.zeros(len(t), [(name, sign + kind) for name, (_, kind, _, _) in columns.items()])
    info = ["#INFOFILE1.1 (UTF-8) - Do not remove this line!", "File.Format = erg", f"File.ByteOrder = {order}",
            "File.DateInSeconds = 1750288191", "Comment:", "\tFile.At.1.Name = no line of its own"]  # fmt: skip
    for k, (name, (kind, _, unit, values)) in enumerate(columns.items(), start=1):
        info += [f"File.At.{k}.Name = {name}", f"File.At.{k}.Type = {kind}", f"Quantity.{name}.Unit = {unit}"]
        if values is not None:
            records[name] = values
    info += ["Quantity.VC.Steer.Ang.Factor = 1e-4", "Quantity.VC.Steer.Ang.Offset = 1"]
    size = records.itemsize.to_bytes(2, "little" if sign == "<" else "big")
    path.write_bytes(b"CM-ERG\0\0\0\1" + size + bytes(4) + records.tobytes())
    path.with_name(f"{path.name}.info").write_text("\n".join(info) + "\n")
    return path


def write_xrk(path: Path, until: float = 8.0) -> Path:
    """AiM: GPS at 25 Hz, the others at 100 and 50 Hz in a logger's milliseconds; .xrz deflated."""
    units = {"": 11, "g": 3, "deg": 4, "deg/s": 5, "km/h": 16}
    a, b, c = (signals(np.arange(round(until * rate)) / rate) for rate in (100, 50, 25))
    channels = [("Yaw Rate", "deg/s", 100, np.degrees(a["r"])), ("LatAcc", "g", 100, a["ay"] / 9.80665),
                ("Wheel Speed", "km/h", 50, 3.6 * b["V"]), ("Slip", "deg", 50, np.degrees(b["beta"])),
                ("Steer", "deg", 50, np.degrees(b["delta"])), ("Force", "", 50, b["Fxr"])]  # fmt: skip
    described, samples = b"", []
    for k, (name, unit, rate, values) in enumerate(channels):
        chs = bytearray(112)
        struct.pack_into("<H", chs, 0, k)
        chs[12], chs[16], chs[20], chs[72] = units[unit], 1, 6, 4
        struct.pack_into("<8s24s", chs, 24, name[:7].encode(), name.encode())
        struct.pack_into("<I", chs, 64, 10**6 // rate)
        described += message(b"CHS", bytes(chs))
        samples += [(1000 + 1000 * i // rate, k, b"(S" + struct.pack("<iHf", 1000 + 1000 * i // rate, k, value) + b")")
                    for i, value in enumerate(values)]  # fmt: skip
    for i, place in enumerate(zip(c["x"], c["y"], c["V"], c["course"], strict=True)):
        now = 1000 + 40 * i
        samples.append((now, len(channels), message(b"GPS", gps(now, *place))))
    track = b"Circle".ljust(36, b"\0") + struct.pack("<ii", *(round(1e7 * one) for one in START)) + bytes(20)
    content = message(b"CNF", described) + message(b"TRK", track) + b"".join(one for *_, one in sorted(samples))
    path.write_bytes(zlib.compress(content) if path.suffix == ".xrz" else content)
    return path


def message(token: bytes, content: bytes) -> bytes:
    token = token.ljust(4, b"\0")
    head = b"<h" + token + struct.pack("<iB", len(content), 1) + b">"
    return head + content + b"<" + token + struct.pack("<H", sum(content) % 2**16) + b">"


def gps(now: int, x: float, y: float, V: float, course: float) -> bytes:
    """56 bytes: time [ms], and position [cm] and velocity [cm/s] in the frame that turns with the earth."""
    lat, lon = np.radians(np.concatenate(degrees(np.array([x]), np.array([y]))))
    across = A / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    place = across * np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), (1 - E2) * np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    velocity = V * (np.cos(course) * east + np.sin(course) * north)
    whole = [round(100 * one) for one in (*place, 1.0, *velocity, 0.1)]
    return struct.pack("<iIiHBB3iI3iIHBBI", now, now, 0, 2300, 3, 0xDF, *whole, 120, 0, 11, 0)


WRITERS: dict[str, Callable[[Path], Path]] = {
    "lap.ld": write_ld,
    "lap.vbo": write_vbo,
    "lap.erg": write_erg,
    "lap.xrk": write_xrk,
}
DEG, KMH = 0.017453292519943295, 0.2777777777777778
MAPS = {
    "lap.ld": f"""
columns:
  t: time
  V: {{column: Ground Speed, factor: {KMH}}}
  beta: {{column: Slip Angle, factor: {DEG}}}
  r: {{column: Gyro Yaw Velocity, factor: {DEG}}}
  delta: {{column: Steered Angle, factor: {DEG}}}
  Fxr: Drive Force
  ay: {{column: G Force Lat, factor: 9.80665}}
position_from: {{latitude: GPS Latitude, longitude: GPS Longitude}}
""",
    "lap.vbo": f"""
columns:
  t: time
  V: {{column: velocity, factor: {KMH}}}
  beta: {{column: slip, factor: {DEG}}}
  r: yaw
  delta: {{column: steer, factor: {DEG}}}
  Fxr: force
position_from: {{latitude: lat, longitude: long}}
""",
    "lap.erg": """
columns: {t: time, V: Car.v, beta: Car.SideSlipAngle, r: Car.YawRate, delta: VC.Steer.Ang, Fxr: Car.Fx, x: Car.Fr1.tx}
""",
    "lap.xrk": f"""
columns:
  t: time
  V: {{column: Wheel Speed, factor: {KMH}}}
  beta: {{column: Slip, factor: {DEG}}}
  r: {{column: Yaw Rate, factor: {DEG}}}
  delta: {{column: Steer, factor: {DEG}}}
  Fxr: Force
  ay: {{column: LatAcc, factor: 9.80665}}
position_from: {{latitude: GPS Latitude, longitude: GPS Longitude}}
""",
}


def logged(folder: Path, name: str) -> tuple[Path, Path]:
    """The lap in the format of `name`, and the file of its column map."""
    columns = folder / "map.yaml"
    columns.write_text(MAPS[name])
    return WRITERS[name](folder / name), columns
