"""Motion: the path of the ego vehicle, and movers with constant speed along a line of the
street."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidar_synth.geometry.arrays import Float64Array, Int32Array
from lidar_synth.lab.town.objects import Prototype
from lidar_synth.lab.town.scene import PlacedObject, Pose, Scene
from lidar_synth.lab.town.street import LEFT, REACH, RIGHT, Street


class Line(NamedTuple):
    """A motion with constant speed, or a place at which something waits.

    Args:
        along: True if it moves along s, False if it moves along t.
        at: the constant coordinate, metres.
        start: the changing coordinate at time 0, metres.
        direction: +1 or -1, the direction in which it faces.
        speed: m/s; 0 for one that waits.
    """

    along: bool
    at: float
    start: float
    direction: int
    speed: float


@dataclass(frozen=True)
class Mover:
    """A moving object (or one that waits) on a line of constant s or t.

    Args:
        shapes: its prototypes by phase of the stride; a single one for a vehicle.
        stride: metres travelled per cycle of the phases.
        line: its motion.
        instance: its instance number.
        surfaces: the surface number of each slot.
        scale: the scale of its prototype.
    """

    shapes: tuple[Prototype, ...]
    stride: float
    line: Line
    instance: int
    surfaces: Int32Array
    scale: float

    def place(self, time: float) -> tuple[float, float, float]:
        """Its s and t (metres) and its yaw relative to the street (radians) at a time in
        seconds."""
        along, at, start, direction, speed = self.line
        moving = start + direction * speed * time
        back = np.pi if direction < 0 else 0.0
        return (moving, at, back) if along else (at, moving, np.pi / 2 + back)

    def shape(self, time: float) -> Prototype:
        """Its prototype at a time in seconds."""
        travelled = abs(self.line.start) + self.line.speed * time
        phase = int(travelled / self.stride * len(self.shapes))
        return self.shapes[phase % len(self.shapes)]


def place_movers(
    movers: list[Mover],
    scene: Scene,
    time: float,
    about: tuple[float, float],
    reach: float,
) -> list[PlacedObject]:
    """The movers within ``reach`` metres of street coordinates ``about``, placed in the world at a
    time in seconds."""
    places = np.array([m.place(time) for m in movers]).reshape(-1, 3)
    apart = places[:, :2] - about
    near = np.flatnonzero(np.hypot(*apart.T) < reach)
    close = [movers[i] for i in near]
    lengths = [2.0 if len(m.shapes) == 1 else 0.5 for m in close]
    s, t, yaw = places[near].T
    poses = scene.poses(s, t, yaw, lengths)
    return [
        PlacedObject(m.shape(time), pose, m.instance, m.surfaces, m.scale)
        for m, pose in zip(close, poses, strict=True)
    ]


def ego_place(street: Street, time: float) -> tuple[float, float, float]:
    """Street coordinates of the ego vehicle at a time in seconds, and its yaw (radians) relative to
    the street.

    The vehicle follows its lane with a small lateral drift, or turns in an arc into the right lane
    of a side street, where it stops ``REACH`` metres beside the street.
    """
    travelled = street.speed * time
    lane = street.lanes[0].t
    if street.turn is None:
        return travelled, float(lane + 0.15 * np.sin(0.11 * travelled)), 0.0
    crossing, side = street.turn
    radius = {RIGHT: 4.0, LEFT: 8.0}[side]
    begin = crossing.s + side * crossing.half / 2 - radius
    angle = float(np.clip((travelled - begin) / radius, 0, np.pi / 2))
    beyond = max(0.0, travelled - begin - radius * np.pi / 2)
    s = min(travelled, begin) + radius * np.sin(angle)
    t = lane + side * (radius * (1 - np.cos(angle)) + beyond)
    return float(s), float(np.clip(t, -REACH, REACH)), side * angle


def ego_pose(
    street: Street,
    scene: Scene,
    time: float,
    height: float,
    sway: Float64Array,
) -> Pose:
    """(4, 4) sensor to world at a time in seconds.

    Args:
        street, scene: the stretch on which it drives.
        time: seconds since it passed s = 0.
        height: height of the sensor above the ground, metres.
        sway: (roll, pitch) of the body on its suspension, radians.
    """
    pose = scene.poses(*ego_place(street, time), 4.0)
    c, d = np.cos(sway)
    s, z = np.sin(sway)
    rolled = np.array([(1, 0, 0), (0, c, -s), (0, s, c)])
    pitched = np.array([(d, 0, z), (0, 1, 0), (-z, 0, d)])
    pose[:3, :3] = pose[:3, :3] @ pitched @ rolled
    pose[:3, 3] += height * pose[:3, 2]
    return pose
