"""Tracks from YAML and CSV files."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from driftjax.core import BadInput, find_config, from_dict, read_yaml, require, shown
from driftjax.track.build import corner, from_points, playground
from driftjax.track.check import MIN_POINTS
from driftjax.track.frame import Track

COLUMNS = ("x", "y", "w_right", "w_left")
CLOSING_GAP = 2.5  # a track is closed where last and first point are nearer than this many median spacings


@dataclass(frozen=True)
class CornerConfig:
    """One corner between two straights."""

    straight_in: float
    """Straight before the corner [m]."""
    ramp: float
    """Length over which the curvature rises, and later falls, linearly [m]."""
    radius: float
    """Radius of the arc [m]."""
    angle_deg: float
    """Heading gained in all, ramps included [deg]; negative turns right."""
    straight_out: float
    """Straight after the corner [m]."""
    width: float
    """Distance from the centre line to either border [m]."""
    kind: Literal["corner"] = "corner"
    num: int = 601
    """Grid points."""

    def build(self, source: str) -> Track:
        """Build the track."""
        angle = math.radians(self.angle_deg)
        return corner(self.straight_in, self.ramp, self.radius, angle, self.straight_out, self.width, self.num)


@dataclass(frozen=True)
class PlaygroundConfig:
    """A closed lap with a hairpin, fast bends and two corners."""

    scale: float
    """Size; 1 has a hairpin of 15 m radius."""
    width: float
    """Distance from the centre line to either border [m]."""
    kind: Literal["playground"] = "playground"
    num: int = 1600
    """Grid points."""

    def build(self, source: str) -> Track:
        """Build the track."""
        return playground(self.scale, self.width, self.num)


@dataclass(frozen=True)
class CsvConfig:
    """A measured centre line."""

    path: Path
    """CSV of x, y, w_right, w_left [m]; relative to the YAML file."""
    kind: Literal["csv"] = "csv"
    smoothing: float = 0.0
    """Root-mean-square distance by which the curve may miss the points [m]."""
    narrow: bool = False
    """Whether to draw in an inner border that folds over itself, instead of refusing the track."""
    closed: bool | None = None
    """Whether the last point joins the first; left out: where they are neighbours."""

    def __post_init__(self) -> None:
        require(self.smoothing >= 0, f"key 'smoothing' is {self.smoothing}; it must not be negative.")

    def build(self, source: str) -> Track:
        """Build the track."""
        return read_csv(Path(source).parent / self.path, self.smoothing, self.narrow, self.closed)


KINDS = {"corner": CornerConfig, "playground": PlaygroundConfig, "csv": CsvConfig}


def load_track(name: str | Path, narrow: bool = False) -> Track:
    """Load a track from a CSV or YAML file, or a shipped one by name (`sedan_corner`, `rc_corner`, ...).

    Lengths are in metres. `narrow`: for a CSV, draw in an inner border that folds over itself, instead of refusing the
    track. Raises `BadInput` that names file and row or key.
    """
    path = Path(name)
    if path.suffix.lower() == ".csv":
        return read_csv(path, narrow=narrow)
    path = find_config("track", name)
    values = read_yaml(path)
    kind = values.get("kind")
    if kind not in KINDS:
        raise BadInput(f"{path}: key 'kind' is {shown(kind)}; choose one of {', '.join(KINDS)}.")
    config = from_dict(KINDS[kind], values, str(path))
    try:
        return config.build(str(path))
    except BadInput as error:
        raise BadInput(str(error) if kind == "csv" else f"{path}: {error}") from None


def read_csv(path: Path, smoothing: float = 0.0, narrow: bool = False, closed: bool | None = None) -> Track:
    """Read a track from rows `x, y, w_right, w_left` [m]; lines after # and one header row are skipped.

    Closed where the last point lies within 2.5 median spacings of the first, unless `closed` says.
    """
    rows, values = _read_rows(path)
    if len(values) < MIN_POINTS:
        raise BadInput(f"{path}: has {len(values)} points; a track needs at least {MIN_POINTS}.")
    for column in (2, 3):
        if np.any(bad := values[:, column] <= 0):
            i = int(np.argmax(bad))
            raise BadInput(f"{path}, row {rows[i]}: {COLUMNS[column]} is {values[i, column]:g}; widths are positive.")
    gap = np.hypot(*(values[-1, :2] - values[0, :2]))
    spacing = np.median(np.hypot(*np.diff(values[:, :2], axis=0).T))
    closed = bool(gap < CLOSING_GAP * spacing) if closed is None else closed
    if closed and gap < 1e-3 * spacing:  # the first point again
        rows, values = rows[:-1], values[:-1]
    return from_points(*values.T, closed=closed, smoothing=smoothing, narrow=narrow, source=str(path), rows=rows)


def _read_rows(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise BadInput(f"{path}: no such file; check the path.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: cannot be read ({error}); check the file and its permissions.") from None
    rows, values = [], []
    for row, cells in enumerate(csv.reader(text.splitlines()), start=1):
        if not any(cell.strip() for cell in cells) or cells[0].lstrip().startswith("#"):
            continue
        if not values and not any(map(_number, cells)):  # names of the columns
            continue
        values.append(_parse(cells, f"{path}, row {row}"))
        rows.append(row)
    return np.array(rows, dtype=int), np.array(values, dtype=float).reshape(-1, len(COLUMNS))


def _number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _parse(cells: list[str], where: str) -> list[float]:
    if len(cells) != len(COLUMNS):
        raise BadInput(f"{where}: has {len(cells)} cells; it needs 4: {', '.join(COLUMNS)}.")
    for name, cell in zip(COLUMNS, cells, strict=True):
        if not _number(cell) or not math.isfinite(float(cell)):
            raise BadInput(f"{where}: {name} is '{cell.strip()}', not a finite number; correct it.")
    return [float(cell) for cell in cells]
