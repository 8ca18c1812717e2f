"""Read and write tyre property files (.tir) of the Magic Formula 5.2, 6.1 and 6.2."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from driftjax.core import BadInput, write_atomically

LARGEST, LONGEST = 2**20, 2000  # bytes of a file, characters of a line; a tyre property file has some 20 kB
VERSIONS = {5: 52, 51: 52, 52: 52, 6: 52, 61: 61, 62: 62}  # FITTYP: Magic Formula
UNITS: dict[str, tuple[str, ...]] = {
    "LENGTH": ("meter", "metre", "m"),
    "FORCE": ("newton", "n"),
    "ANGLE": ("radian", "radians", "rad"),
    "MASS": ("kg", "kilogram"),
    "TIME": ("second", "seconds", "sec", "s"),
    "PRESSURE": ("pascal", "pa", "n/m^2", "n/m2"),
}
NEEDED = ("FNOMIN", "PCX1", "PDX1", "PKX1", "PCY1", "PDY1", "PKY1", "PKY2")
LINE = re.compile(r"(\s*)([A-Za-z_]\w*)(\s*=\s*)('[^']*'|[^$!']*?)(\s*)([$!].*)?")


@dataclass(frozen=True)
class TyreFile:
    """A tyre property file: its numbers, and its lines, so that writing keeps comments and tables."""

    name: str
    """File name, for messages."""
    version: int
    """Magic Formula: 52, 61 or 62."""
    mirrored: bool
    """Whether the tyre was measured on the right side of a car."""
    values: Mapping[str, float]
    """Numbers by key, as written; keys without a number are left out."""
    lines: tuple[str, ...]
    """Lines of the file."""

    def replaced(self, values: Mapping[str, float]) -> "TyreFile":
        """Return the file with other numbers; keys that it lacks are added."""
        return TyreFile(self.name, self.version, self.mirrored, {**self.values, **values}, self.lines)


def read_tir(path: str | Path) -> TyreFile:
    """Read a tyre property file; raises `BadInput` that names file, line or key if it is not one, or not in SI.

    Nothing in it is executed. Keys of [UNITS] and [MODEL] are checked; tables, such as [SHAPE], are kept as lines.
    """
    path = Path(path)
    lines = _lines(path)
    values: dict[str, float] = {}
    words: dict[str, str] = {}
    section = ""
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if text.startswith("["):
            section = text.partition("]")[0][1:].strip().upper()
        elif "=" in text and text[0] not in "$!":
            match = LINE.fullmatch(line)
            if match is None:
                raise BadInput(f"{path}, line {number}: is no 'KEY = value'; correct it.")
            _take(f"{path}, line {number}", section, match[2].upper(), match[4].strip(), values, words)
    for key, known in UNITS.items():
        unit = words.get(f"UNITS.{key}", known[0]).lower()
        if unit not in known:
            raise BadInput(f"{path}: {key} is in '{unit}'; convert the file to SI units ({known[0]}).")
    if missing := [key for key in NEEDED if key not in values]:
        raise BadInput(
            f"{path}: '{missing[0]}' is missing; give a tyre property file of Magic Formula 5.2, 6.1 or 6.2."
        )
    if values["FNOMIN"] <= 0 or not values["PKY2"]:
        raise BadInput(f"{path}: FNOMIN is {values['FNOMIN']} and PKY2 {values['PKY2']}; both must differ from 0.")
    default = 52.0 if words.get("MODEL.PROPERTY_FILE_FORMAT", "").upper() == "PAC2002" else math.nan
    kind = values.get("FITTYP", default)
    if kind not in VERSIONS:
        raise BadInput(f"{path}: FITTYP is {kind:g}; it must be one of {', '.join(map(str, VERSIONS))}.")
    return TyreFile(path.name, VERSIONS[int(kind)], words.get("MODEL.TYRESIDE", "").upper() == "RIGHT", values, lines)


def _lines(path: Path) -> tuple[str, ...]:
    try:
        if path.stat().st_size > LARGEST:
            raise BadInput(f"{path}: is larger than a tyre property file can be; give a .tir file.")
        text = path.read_bytes()
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file; check the path.") from None
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}); check the file and its permissions.") from None
    if b"\0" in text:
        raise BadInput(f"{path}: is no text; give a .tir file.")
    lines = text.decode("latin-1").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for number, line in enumerate(lines, 1):
        if len(line) > LONGEST:
            raise BadInput(f"{path}, line {number}: has {len(line)} characters; give a .tir file.")
    return tuple(lines)


def _take(where: str, section: str, key: str, written: str, values: dict[str, float], words: dict[str, str]) -> None:
    """Take one value: a number by its key, a word by section and key; blank ones are left out."""
    if not written:
        return
    if written.startswith("'") or section == "UNITS":
        words[f"{section}.{key}"] = written.strip("'").strip()
        return
    try:
        number = float(written)
    except ValueError:
        if section == "INERTIA" or section not in ("MODEL", "VERTICAL") and "COEFFICIENTS" not in section:
            return  # some writers leave units where numbers should be; these sections are not used
        raise BadInput(f"{where}: {key} is '{written[:40]}'; it needs a number.") from None
    if not math.isfinite(number):
        raise BadInput(f"{where}: {key} is {written[:40]}; it needs a finite number.")
    if key in values and values[key] != number and "COEFFICIENTS" in section:
        raise BadInput(f"{where}: {key} stands twice with different numbers; keep one.")
    values[key] = number


def write_tir(path: str | Path, file: TyreFile) -> None:
    """Write a tyre property file: the lines as they were, with the present numbers, SI; new keys come at the end.

    Raises `BadInput` for a path that cannot be written.
    """
    left = dict(file.values)
    lines = []
    for line in file.lines:
        match = LINE.fullmatch(line)
        key = match[2].upper() if match and line.strip()[0] not in "$!" else ""
        if match is None or key not in left or match[4].startswith("'"):
            lines.append(line)
            continue
        value = left.pop(key)
        same = match[4].strip() and float(match[4]) == value
        lines.append(line if same else f"{match[1]}{match[2]}{match[3]}{value!r} {match[6] or ''}".rstrip())
    if left:
        lines += ["[ADDED_COEFFICIENTS]", *(f"{key:<25}= {value!r}" for key, value in left.items())]
    text = "\n".join(lines).rstrip("\n") + "\n"
    try:
        write_atomically(Path(path), lambda temporary: temporary.write_text(text, encoding="latin-1"))
    except OSError as error:
        raise BadInput(f"{path}: cannot be written ({error.strerror}); give another path.") from None
