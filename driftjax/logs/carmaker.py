"""Read CarMaker results (.erg): records of one time base, described by a text file beside it (.erg.info).

The library cmerg is not used: version 0.4 fails where a quantity has a factor, and returns wrong numbers without an
error where no blank line separates the quantities.
"""

from pathlib import Path

import numpy as np

from driftjax.core import BadInput
from driftjax.logs.series import Series, pick_channels

KIND = "CarMaker file"
MAGIC = b"CM-ERG"
HEADER = 16  # bytes before the first record
SIZE_AT = 10  # where the header holds the size of a record, in two bytes
TIME = "Time"
TYPES = {"Float": "f4", "Double": "f8", "LongLong": "i8", "ULongLong": "u8", "Long": "i4", "ULong": "u4", "Int": "i4",
         "UInt": "u4", "Short": "i2", "UShort": "u2", "Char": "i1", "UChar": "u1"}  # fmt: skip
TYPES |= {f"{n} Bytes": f"V{n}" for n in range(1, 8)}  # fill up a record
ORDERS = {"LittleEndian": "<", "BigEndian": ">"}


def info_path(path: Path) -> Path:
    """Return the path of the file that describes the records."""
    return path.with_name(f"{path.name}.info")


def carmaker_channels(path: Path) -> dict[str, str]:
    """Return the unit of every quantity."""
    info = _info(path)
    return {name: _of(info, name, "Unit", "") for name, kind in _quantities(path, info) if not kind.startswith("V")}


def carmaker_series(path: Path, names: list[str]) -> dict[str, Series]:
    """Return the quantities `names` over the quantity Time."""
    info = _info(path)
    quantities = _quantities(path, info)
    content, record = path.read_bytes(), _record(path, info, quantities)
    size = int.from_bytes(content[SIZE_AT : SIZE_AT + 2], "big" if info["File.ByteOrder"] == "BigEndian" else "little")
    if size not in (0, record.itemsize) or len(content) < HEADER:
        raise BadInput(f"{path}: has records of {size} bytes where {info_path(path).name} describes "
                       f"{record.itemsize}; give the two files of one simulation.")  # fmt: skip
    records = np.frombuffer(content, record, (len(content) - HEADER) // record.itemsize, HEADER)
    places = pick_channels(path, [TIME, *names], [(name, f"f{k}") for k, (name, _) in enumerate(quantities)])
    if text := next((name for name in names if record[places[name]].kind == "V"), None):
        raise BadInput(f"{path}: quantity '{text}' holds no number; correct the column map.")
    t = _scaled(path, info, TIME, records[places[TIME]])
    return {name: Series("its records", t, _scaled(path, info, name, records[places[name]])) for name in names}


def _info(path: Path) -> dict[str, str]:
    """Return the `key = value` lines of the description."""
    try:
        text = info_path(path).read_bytes().decode("utf-8-sig", "replace")
    except OSError as error:
        raise BadInput(f"{path}: cannot be read without {info_path(path).name} beside it ({error.strerror}); "
                       "copy that file too.") from None  # fmt: skip
    pairs = (line.partition("=") for line in text.splitlines() if not line.startswith(("#", "\t")))
    return {key.strip().strip('"'): value.strip() for key, equals, value in pairs if equals}


def _quantities(path: Path, info: dict[str, str]) -> list[tuple[str, str]]:
    """Return name and type of the quantities of a record, in order."""
    quantities, wrong = [], f"{info_path(path)}: "
    while (name := info.get(f"File.At.{len(quantities) + 1}.Name")) is not None:
        kind = info.get(f"File.At.{len(quantities) + 1}.Type", "")
        if kind not in TYPES:
            raise BadInput(f"{wrong}quantity '{name}' has the type '{kind}', which is none of CarMaker's; mend it.")
        quantities.append((name, TYPES[kind]))
    if not quantities:
        raise BadInput(f"{wrong}describes no quantity (File.At.1.Name); give the file that CarMaker wrote.")
    return quantities


def _record(path: Path, info: dict[str, str], quantities: list[tuple[str, str]]) -> np.dtype:
    order = ORDERS.get(info.get("File.ByteOrder", ""))
    if order is None:
        raise BadInput(f"{info_path(path)}: key 'File.ByteOrder' is none of {', '.join(ORDERS)}; mend it.")
    return np.dtype([(f"f{k}", order + kind) for k, (_, kind) in enumerate(quantities)])


def _of(info: dict[str, str], name: str, key: str, default: str) -> str:
    return info.get(f"Quantity.{name}.{key}", default)


def _scaled(path: Path, info: dict[str, str], name: str, values: np.ndarray) -> np.ndarray:
    factor, offset = _of(info, name, "Factor", "1"), _of(info, name, "Offset", "0")
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # of damaged samples
            return values.astype(float) * float(factor) + float(offset)
    except ValueError:
        raise BadInput(f"{info_path(path)}: quantity '{name}' has factor '{factor}' and offset '{offset}'; "
                       "write numbers.") from None  # fmt: skip
