"""Animate a learnt drift: the nominal and the explored lap of one plant side by side, as a GIF.

python -m experiments.animation --run runs/learn-sedan-... --out docs/_static/drift.gif
"""

import dataclasses
import io
from pathlib import Path

import numpy as np
import tyro
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.text import Text
from PIL import Image

import driftjax as dj
from driftjax.report.laps import Lap, read_laps
from driftjax.report.posture import outline
from driftjax.report.style import EXPLORED, NOMINAL, new_figure

ROAD, PATH, TYRE = "#E8E8E8", "#222222", "#202020"
STAGES = {"nominal": (NOMINAL, "before learning: nominal model"), "explore-best": (EXPLORED, "after learning")}


@dataclasses.dataclass(frozen=True)
class Config:
    """A run of `driftjax learn`, and what of it is shown."""

    run: Path
    """Run folder of `driftjax learn`."""
    out: Path = Path("docs/_static/drift.gif")
    """GIF to write."""
    lane: int = 0
    """Number of the plant in the run, from 0."""
    before: float = 14.0
    """Distance before the drift section where it begins [m]."""
    after: float = 12.0
    """Distance after the drift section where it ends [m]."""
    colours: int = 96
    """Colours of the GIF: fewer make it smaller."""
    frames: Path | None = None
    """Folder for every tenth frame as a PNG, to look at."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """What moves in one panel, and in the strip of lateral errors."""

    lap: Lap
    first: int
    body: Polygon
    wheels: list[Polygon]
    trail: LineCollection
    words: Text
    curve: Line2D

    def show(self, vehicle: dj.VehicleConfig, k: int) -> None:
        """Move everything to control step `k`; a lap that is over stands still."""
        lap = self.lap
        k = min(k, len(lap["x"]) - 1)
        x, y, psi, delta = (lap[name][k] for name in ("x", "y", "psi", "delta"))
        self.body.set_xy(outline(x, y, psi, vehicle))
        for wheel, corners in zip(self.wheels, wheel_corners(x, y, psi, delta, vehicle), strict=True):
            wheel.set_xy(corners)
        past = slice(self.first, k + 1)
        points = np.stack([lap["x"][past], lap["y"][past]], axis=1)
        self.trail.set_segments(list(np.stack([points[:-1], points[1:]], axis=1)))
        self.trail.set_array(np.abs(lap["e"][past][1:]))
        sideslip, off = round(np.rad2deg(lap["beta"][k])), abs(lap["e"][k])
        self.words.set_text(f"{sideslip:6d} deg sideslip\n{off:6.2f} m off the path")
        self.curve.set_data(lap["s"][past], np.abs(lap["e"][past]))


def wheel_corners(x: float, y: float, psi: float, delta: float, vehicle: dj.VehicleConfig) -> list[np.ndarray]:
    """Return the corners (4, 2) of the four wheels [m], the front ones steered by `delta` [rad]."""
    half, long, wide = 0.42 * vehicle.width, 0.075 * vehicle.length, 0.07 * vehicle.width
    rim = np.array([[long, wide], [long, -wide], [-long, -wide], [-long, wide]])
    turn = lambda angle: np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    places = [(vehicle.a, half, delta), (vehicle.a, -half, delta), (-vehicle.b, half, 0.0), (-vehicle.b, -half, 0.0)]
    return [(np.array([u, v]) + rim @ turn(steer).T) @ turn(psi).T + [x, y] for u, v, steer in places]


def draw_road(axis: Axes, plan: xr.Dataset, view: tuple[float, float, float, float]) -> None:
    """Draw road and planned path, without axes, in the window `view` (left, right, bottom, top) [m]."""
    left, right = (np.stack([plan[f"{side}_x"], plan[f"{side}_y"]], axis=1) for side in ("left", "right"))
    axis.add_patch(Polygon(np.concatenate([left, right[::-1]]), fc=ROAD, ec="#B0B0B0", lw=1.0, zorder=0))
    axis.plot(plan["path_x"], plan["path_y"], color=PATH, lw=1.0, ls=(0, (4, 3)), zorder=2)
    axis.set(xlim=view[:2], ylim=view[2:], aspect="equal")
    axis.set_axis_off()


def build(run: dj.RunFolder, plan: xr.Dataset, vehicle: dj.VehicleConfig, config: Config) -> tuple[Figure, list[Scene]]:
    """Draw what does not move and create what does."""
    start, end = plan.attrs["drift_start"] - config.before, plan.attrs["drift_end"] + config.after
    near = (plan["path_s"].values >= start) & (plan["path_s"].values <= end)
    x, y, pad = plan["path_x"].values[near], plan["path_y"].values[near], 1.4 * vehicle.length
    view = (x.min() - pad, x.max() + pad, y.min() - pad, y.max() + pad)
    laps = {stage: read_laps(run.read_stage(stage), "path")[config.lane] for stage in STAGES}
    worst = max(np.abs(lap["e"][(lap["s"] > start) & (lap["s"] < end)]).max() for lap in laps.values())
    figure, axes = new_figure(2, 2, (8.4, 5.6), height_ratios=[3.4, 1.0])
    for axis in axes[1]:
        axis.remove()
    strip = figure.add_subplot(axes[1, 0].get_gridspec()[1, :])
    strip.set(xlim=(start, end), ylim=(0, 1.1 * worst), xlabel="distance along the planned path [m]",
              ylabel="off the\npath [m]")  # fmt: skip
    scenes = []
    for axis, (stage, (colour, title)) in zip(axes[0], STAGES.items(), strict=True):
        lap = laps[stage]
        draw_road(axis, plan, view)
        axis.set_title(f"{title} (mean {lap.lateral_error:.2f} m off)", color=colour, fontsize=11)
        body = axis.add_patch(Polygon(np.zeros((6, 2)), closed=True, fc=colour, ec="white", lw=0.8, zorder=5))
        wheels = [axis.add_patch(Polygon(np.zeros((4, 2)), closed=True, fc=TYRE, zorder=6)) for _ in range(4)]
        trail = LineCollection([], cmap="plasma", lw=2.6, zorder=3, clim=(0.0, worst))
        axis.add_collection(trail)
        words = axis.text(
            0.5, 0.5, "", transform=axis.transAxes, ha="center", va="center", fontsize=9.5, family="monospace"
        )
        (curve,) = strip.plot([], [], color=colour, lw=2.0)
        first = int(np.argmax(lap["s"] >= start))
        scenes.append(Scene(lap, first, body, wheels, trail, words, curve))
    return figure, scenes


def main(config: Config) -> None:
    """Write the GIF."""
    run = dj.RunFolder.open(config.run)
    plan, vehicle = run.read_dataset("plan.nc"), dj.load_vehicle(run.config["vehicle"])
    figure, scenes = build(run, plan, vehicle, config)
    end = plan.attrs["drift_end"] + config.after
    last = max(int(np.argmax(scene.lap["s"] >= end)) or len(scene.lap["s"]) for scene in scenes)
    images = []
    for k in range(min(scene.first for scene in scenes) + 1, last):
        for scene in scenes:
            scene.show(vehicle, k)
        page = io.BytesIO()
        figure.savefig(page, format="png", dpi=100)
        images.append(Image.open(page).convert("RGB"))
    palette = images[-1].quantize(config.colours)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    step = round(1000 * float(np.diff(run.read_stage("nominal")["t"].values[:2])[0]))  # ms
    config.out.parent.mkdir(parents=True, exist_ok=True)
    pauses = [step] * (len(frames) - 1) + [1500]
    frames[0].save(config.out, save_all=True, append_images=frames[1:], duration=pauses, loop=0, optimize=True)
    if config.frames is not None:
        config.frames.mkdir(parents=True, exist_ok=True)
        for k in range(0, len(images), 10):
            images[k].save(config.frames / f"{k:03d}.png")
    print(f"{config.out}: {len(frames)} frames, {config.out.stat().st_size / 1e6:.2f} MB, plant {scenes[0].lap.plant}")


if __name__ == "__main__":
    main(tyro.cli(Config))
