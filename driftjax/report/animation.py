"""Animate the cars of a run: nominal beside explored lap, or measurement beside predictions, as GIF or MP4."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib.animation
import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.text import Text
from PIL import Image

from driftjax.core import BadInput, write_atomically
from driftjax.report.drives import CarDrive
from driftjax.report.player import AFTER, BEFORE
from driftjax.report.shape import outline, wheel_corners
from driftjax.report.style import DRIVES, new_figure
from driftjax.vehicle import VehicleConfig

ROAD, PATH, TYRE = "#E8E8E8", "#222222", "#202020"
COLOURS = 96  # of a GIF: fewer make it smaller
RATE = 20.0  # frames per second at most
PAUSE = 1500  # at the end of a GIF [ms]
FOLLOWED = 2.5  # half of the view that follows a car, in car lengths


@dataclasses.dataclass(frozen=True)
class AnimatedCar:
    """A car in a panel, and its curve in the strip below."""

    states: list[dict[str, float] | None]  # per frame; None where there is no prediction
    points: np.ndarray  # (frames, 4): place on the map, and in the strip
    body: Polygon
    wheels: list[Polygon]
    trail: Line2D
    curve: Line2D

    def show(self, vehicle: VehicleConfig, k: int) -> dict[str, float] | None:
        """Move to frame `k`; invisible where there is no prediction."""
        at = self.states[k]
        artists: list[Artist] = [self.body, *self.wheels]
        for artist in artists:
            artist.set_visible(at is not None)
        x, y, along, value = self.points[: k + 1].T
        self.trail.set_data(x, y)
        self.curve.set_data(along, value)
        if at is not None:
            pose = at["x"], at["y"], at["psi"]
            self.body.set_xy(outline(*pose, vehicle))
            for wheel, corners in zip(self.wheels, wheel_corners(*pose, at.get("delta", 0.0), vehicle), strict=True):
                wheel.set_xy(corners)
        return at


@dataclasses.dataclass(frozen=True)
class Panel:
    """One panel: a car, perhaps a ghost, and the numbers beside it."""

    axis: Axes
    cars: list[AnimatedCar]
    words: Text
    follows: bool

    def show(self, vehicle: VehicleConfig, k: int) -> None:
        """Move everything to frame `k`."""
        at, *_ = [car.show(vehicle, k) for car in self.cars]
        if at is None:
            return
        text = f"{round(np.rad2deg(at['beta'])):6d} deg sideslip"
        self.words.set_text(text + (f"\n{abs(at['e']):6.2f} m off the path" if "e" in at else ""))
        if self.follows:
            half = FOLLOWED * vehicle.length
            self.axis.set(xlim=(at["x"] - half, at["x"] + half), ylim=(at["y"] - half, at["y"] + half))


def strip_point(at: dict[str, float]) -> tuple[float, float]:
    """Return the point of a car in the strip: error over arc length of a lap, sideslip over time of a measured run."""
    return (at["s"], abs(at["e"])) if "e" in at else (at["t"], np.rad2deg(at["beta"]))


def draw_road(axis: Axes, plan: xr.Dataset) -> None:
    """Draw road and planned path."""
    left, right = (np.stack([plan[f"{side}_x"], plan[f"{side}_y"]], axis=1) for side in ("left", "right"))
    axis.add_patch(Polygon(np.concatenate([left, right[::-1]]), fc=ROAD, ec="#B0B0B0", lw=1.0, zorder=0))
    axis.plot(plan["path_x"], plan["path_y"], color=PATH, lw=1.0, ls=(0, (4, 3)), zorder=2)


def add_car(axis: Axes, strip: Axes, drive: CarDrive, times: Sequence[float], ghost: bool) -> AnimatedCar:
    """Create the artists of a car."""
    states = [drive.at(t) for t in times]
    points = np.array([(one["x"], one["y"], *strip_point(one)) if one else (np.nan,) * 4 for one in states])
    begun = np.searchsorted([piece["t"][0] for piece in drive.pieces], times, side="right")
    points[1:][np.diff(begun) > 0] = np.nan  # no line from the end of one prediction to the start of the next
    colour, alpha = DRIVES[drive.kind], 0.4 if ghost else 1.0
    body = Polygon(np.zeros((6, 2)), closed=True, fc=colour, ec="white", lw=0.8, alpha=alpha, zorder=5)
    wheels = [Polygon(np.zeros((4, 2)), closed=True, fc=TYRE, alpha=alpha, zorder=6) for _ in range(4)]
    for patch in (body, *wheels):
        axis.add_patch(patch)
    (trail,) = axis.plot([], [], color=colour, lw=1.0 if ghost else 2.2, zorder=3)
    (curve,) = strip.plot([], [], color=colour, lw=1.4 if drive.kind == "measured" else 2.0, label=drive.name)
    return AnimatedCar(states, points, body, wheels, trail, curve)


def label_curves(strip: Axes) -> None:
    """Name the colours of the curves above the strip, each once."""
    handles, names = strip.get_legend_handles_labels()
    named = dict(zip(names, handles, strict=True))
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
    strip.legend(named.values(), named.keys(), ncols=len(named), frameon=False, **place)


def build_animation(
    vehicle: VehicleConfig, pairs: Sequence[Sequence[CarDrive]], times: Sequence[float], plan: xr.Dataset | None
) -> tuple[Figure, list[Panel]]:
    """Draw the static parts and create the moving ones: a panel per car and, if given, its ghost."""
    figure, axes = new_figure(2, len(pairs), (4.2 * len(pairs), 5.6), height_ratios=[3.4, 1.0])
    for axis in axes[1]:
        axis.remove()
    strip = figure.add_subplot(axes[1, 0].get_gridspec()[1, :])
    xlabel, ylabel = ("time [s]", "sideslip [deg]") if plan is None else ("distance along the planned path [m]",
                                                                          "off the\npath [m]")  # fmt: skip
    strip.set(xlabel=xlabel, ylabel=ylabel)
    panels = []
    for axis, drives in zip(axes[0], pairs, strict=True):
        if plan is not None:
            draw_road(axis, plan)
            near = abs(plan["path_s"].values - sum(_span(plan)) / 2) < (_span(plan)[1] - _span(plan)[0]) / 2
            x, y, pad = plan["path_x"].values[near], plan["path_y"].values[near], 1.4 * vehicle.length
            axis.set(xlim=(x.min() - pad, x.max() + pad), ylim=(y.min() - pad, y.max() + pad))
        axis.set(aspect="equal")
        axis.set_axis_off()
        axis.set_title(
            "\n".join(filter(None, (drives[-1].name, drives[-1].note))), color=DRIVES[drives[-1].kind], fontsize=11
        )
        cars = [add_car(axis, strip, drive, times, k > 0) for k, drive in enumerate(drives)]
        place = (0.5, 0.5) if plan is not None else (0.5, 0.04)
        words = axis.text(
            *place, "", transform=axis.transAxes, ha="center", va="center", fontsize=9.5, family="monospace", zorder=7,
            bbox={"fc": figure.get_facecolor(), "ec": "none", "pad": 2.0} if plan is None else None,
        )  # fmt: skip
        panels.append(Panel(axis, cars, words, plan is None))
    if plan is None:
        label_curves(strip)
    seen = np.concatenate([panel.cars[0].points[:, 2:] for panel in panels])
    low, high = np.minimum(np.nanmin(seen, axis=0), [np.inf, 0.0]), np.maximum(np.nanmax(seen, axis=0), [-np.inf, 1e-3])
    strip.set(xlim=(low[0], high[0]), ylim=(1.1 * low[1], 1.1 * high[1]))
    return figure, panels


def _span(plan: xr.Dataset) -> tuple[float, float]:
    return plan.attrs["drift_start"] - BEFORE, plan.attrs["drift_end"] + AFTER


def film_times(pairs: Sequence[Sequence[CarDrive]], plan: xr.Dataset | None) -> list[float]:
    """Return the times of the frames [s]: of the corner of a lap, else of the whole run."""
    laps = [drives[0].pieces[0] for drives in pairs]
    step = max(float(laps[0]["t"][1] - laps[0]["t"][0]), 1 / RATE)
    start, end = min(lap["t"][0] for lap in laps), max(lap["t"][-1] for lap in laps)
    if plan is not None:
        inside = [lap["t"][(lap["s"] >= _span(plan)[0]) & (lap["s"] <= _span(plan)[1])] for lap in laps]
        driven = [t for t in inside if t.size]
        start, end = min((t[0] for t in driven), default=start), max((t[-1] for t in driven), default=end)
    return np.arange(start, end + step / 2, step).tolist()


def animate(
    path: Path, vehicle: VehicleConfig, pairs: Sequence[Sequence[CarDrive]], plan: xr.Dataset | None = None
) -> int:
    """Write a film with a panel per pair, as GIF or MP4 by the suffix of `path`; returns the number of frames.

    Raises `BadInput` where ffmpeg is missing for an MP4.
    """
    times = film_times(pairs, plan)
    step = times[1] - times[0]
    if path.suffix == ".mp4" and not matplotlib.animation.FFMpegWriter.isAvailable():
        raise BadInput(
            f"{path}: an MP4 needs the program ffmpeg; install it (apt-get install ffmpeg) or write a --gif."
        )
    figure, panels = build_animation(vehicle, pairs, times, plan)

    def frames() -> Iterator[None]:
        for k in range(len(times)):
            for panel in panels:
                panel.show(vehicle, k)
            yield

    write_atomically(path, lambda target: (_gif if path.suffix == ".gif" else _mp4)(target, figure, frames(), step))
    return len(times)


def _gif(path: Path, figure: Figure, frames: Iterator[None], step: float) -> None:
    """Write a GIF of few colours whose frames differ in few places, so that it is small."""
    images = []
    for _ in frames:
        figure.canvas.draw()
        figure.set_layout_engine("none")  # laid out by now
        images.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB"))  # pyright: ignore[reportAttributeAccessIssue]
    palette = images[-1].quantize(COLOURS)
    small = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    pauses = [round(1000 * step)] * (len(small) - 1) + [PAUSE]
    small[0].save(path, format="GIF", save_all=True, append_images=small[1:], duration=pauses, loop=0, optimize=True)


def _mp4(path: Path, figure: Figure, frames: Iterator[None], step: float) -> None:
    """Write an MP4 through ffmpeg."""
    writer = matplotlib.animation.FFMpegWriter(fps=round(1 / step), extra_args=["-f", "mp4", "-pix_fmt", "yuv420p"])
    with writer.saving(figure, str(path), dpi=140):
        for _ in frames:
            writer.grab_frame()
