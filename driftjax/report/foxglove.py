"""Write the cars of a run as MCAP with Foxglove's schemas: transforms, poses, scenes, paths and states."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.colors import to_rgba

from driftjax.core import write_atomically
from driftjax.logs.extras import import_extra
from driftjax.report.drives import CarDrive
from driftjax.report.shape import wheels
from driftjax.report.style import DRIVES
from driftjax.vehicle import VehicleConfig

FRAME = "map"
HEIGHT = 0.3  # of the car that is drawn, over its length [-]
LIFETIME = 250_000_000  # of a car in the scene, so that a prediction that has ended vanishes [ns]
SCHEMAS = (
    "CubePrimitive",
    "ArrowPrimitive",
    "LinePrimitive",
    "FrameTransform",
    "PoseInFrame",
    "PosesInFrame",
    "Pose",
    "Point3",
    "SceneEntity",
    "SceneUpdate",
)


def topic_name(words: str) -> str:
    """Return the name of a car in topics and frames."""
    return re.sub(r"[^a-z0-9]+", "_", words.lower()).strip("_")


class Recorder:
    """Writer of one file; times are seconds from the start of the lap or run, left and up are positive."""

    def __init__(self, path: Path, stream: Any, states: Sequence[str]) -> None:
        get = lambda module: import_extra(path, "writing MCAP", "mcap", module)
        self.counts: Counter[str] = Counter()
        self.writer = get("mcap_protobuf.writer").Writer(stream)
        self.types = {name: getattr(get(f"foxglove_schemas_protobuf.{name}_pb2"), name) for name in SCHEMAS}
        self.state = state_class(get, states)

    def write(self, topic: str, t: float, message: Any) -> None:
        """Write a message at time `t` [s], which also stands in its time stamps."""
        time = round(t * 1e9)
        for stamped in (message, *getattr(message, "entities", ())):
            if "timestamp" in stamped.DESCRIPTOR.fields_by_name:
                stamped.timestamp.FromNanoseconds(time)
        self.writer.write_message(topic, message, log_time=time, publish_time=time)
        self.counts[topic] += 1

    def pose(self, x: float, y: float, psi: float, z: float = 0.0) -> Any:
        """Return a pose; `psi` is the heading [rad]."""
        pose = self.types["Pose"]()
        pose.position.x, pose.position.y, pose.position.z = float(x), float(y), z
        pose.orientation.z, pose.orientation.w = float(np.sin(psi / 2)), float(np.cos(psi / 2))
        return pose

    def road(self, plan: xr.Dataset) -> None:
        """Write borders and planned path as lines, and the plan as poses."""
        entity = self.types["SceneEntity"](id="track", frame_id=FRAME, frame_locked=True)
        for side, tint in (("left", "0.5"), ("right", "0.5"), ("path", "black")):
            line = self.types["LinePrimitive"](type=0, thickness=0.1, pose=self.pose(0, 0, 0))
            for x, y in zip(plan[f"{side}_x"].values, plan[f"{side}_y"].values, strict=True):
                line.points.append(self.types["Point3"](x=float(x), y=float(y)))
            paint(line.color, tint)
            entity.lines.append(line)
        self.write("/track", 0.0, self.types["SceneUpdate"](entities=[entity]))
        self.path("/plan", plan["x"].values, plan["y"].values, plan["psi"].values)

    def path(self, topic: str, *pose: np.ndarray) -> None:
        """Write a whole path as poses of x, y, psi, at time 0."""
        poses = [self.pose(*one) for one in zip(*pose, strict=True)]
        self.write(topic, 0.0, self.types["PosesInFrame"](frame_id=FRAME, poses=poses))

    def car(self, vehicle: VehicleConfig, drive: CarDrive, t: float, at: dict[str, float]) -> None:
        """Write transform, pose, scene and state of a car at time `t` [s]."""
        name = topic_name(drive.name)
        pose = self.pose(at["x"], at["y"], at["psi"])
        transform = self.types["FrameTransform"](parent_frame_id=FRAME, child_frame_id=name, rotation=pose.orientation)
        transform.translation.x, transform.translation.y = at["x"], at["y"]
        self.write("/tf", t, transform)
        self.write(f"/{name}/pose", t, self.types["PoseInFrame"](frame_id=FRAME, pose=pose))
        self.write(f"/{name}/scene", t, self.types["SceneUpdate"](entities=[self.entity(vehicle, drive, at)]))
        values = {field: at.get(field, float("nan")) for field in self.state.DESCRIPTOR.fields_by_name}
        self.write(f"/{name}/state", t, self.state(**values))

    def entity(self, vehicle: VehicleConfig, drive: CarDrive, at: dict[str, float]) -> Any:
        """Return body, steered wheels and velocity of a car, in the car's frame, which they follow between samples."""
        name, shape = topic_name(drive.name), wheels(vehicle)
        entity = self.types["SceneEntity"](id=name, frame_id=name, frame_locked=True)
        entity.lifetime.FromNanoseconds(LIFETIME)
        high = HEIGHT * vehicle.length
        middle = ((vehicle.a - vehicle.b) / 2, 0.0)
        boxes = [(middle, 0.0, (vehicle.length, vehicle.width, high / 2), DRIVES[drive.kind], 0.6 * high)]
        for k, place in enumerate(shape["places"]):
            size = (shape["length"], shape["width"], shape["length"])
            boxes.append((place, at.get("delta", 0.0) if k < 2 else 0.0, size, "black", shape["length"] / 2))
        for (u, v), turn, (long, wide, tall), tint, z in boxes:
            cube = self.types["CubePrimitive"](pose=self.pose(u, v, turn, z))
            cube.size.x, cube.size.y, cube.size.z = long, wide, tall
            paint(cube.color, tint)
            entity.cubes.append(cube)
        arrow = self.types["ArrowPrimitive"](
            pose=self.pose(0.0, 0.0, at["beta"], high),
            shaft_length=0.25 * at["V"],
            shaft_diameter=0.05 * vehicle.width,
            head_length=0.2 * vehicle.width,
            head_diameter=0.15 * vehicle.width,
        )
        paint(arrow.color, "black")
        entity.arrows.append(arrow)
        return entity


def paint(colour: Any, tint: str) -> None:
    """Set a message's colour to that of Matplotlib's name `tint`."""
    colour.r, colour.g, colour.b, colour.a = to_rgba(tint)


def state_class(get: Callable[[str], Any], names: Sequence[str]) -> Any:
    """Return the message driftjax.State: a double per name, SI; a value that a car lacks is NaN."""
    file = get("google.protobuf.descriptor_pb2").FileDescriptorProto(
        name="driftjax/State.proto", package="driftjax", syntax="proto3"
    )
    message = file.message_type.add(name="State")
    for number, name in enumerate(names, 1):
        message.field.add(name=name, number=number, type=1, label=1)  # an optional double
    pool = get("google.protobuf.descriptor_pool").DescriptorPool()
    pool.Add(file)
    descriptor = pool.FindMessageTypeByName("driftjax.State")
    return get("google.protobuf.message_factory").GetMessageClass(descriptor)


def write_mcap(path: Path, vehicle: VehicleConfig, drives: Sequence[CarDrive], plan: xr.Dataset | None) -> Counter[str]:
    """Write `drives`, which are shown together, and the road of `plan`; returns the number of messages per topic.

    Raises `BadInput` where the extra `mcap` is not installed.
    """
    states = list(dict.fromkeys(name for drive in drives for piece in drive.pieces for name in piece))
    times = np.unique(np.concatenate([drive.pieces[0]["t"] for drive in drives if len(drive.pieces) == 1]))
    counts: Counter[str] = Counter()

    def write(target: Path) -> None:
        with target.open("wb") as stream:
            recorder = Recorder(path, stream, states)
            if plan is not None:
                recorder.road(plan)
            for drive in drives:
                if len(drive.pieces) == 1:
                    recorder.path(
                        f"/{topic_name(drive.name)}/path", *(drive.pieces[0][key] for key in ("x", "y", "psi"))
                    )
            for t in times.tolist():
                for drive in drives:
                    if (at := drive.at(t)) is not None:
                        recorder.car(vehicle, drive, t, at)
            recorder.writer.finish()
            counts.update(recorder.counts)

    write_atomically(path, write)
    return counts
