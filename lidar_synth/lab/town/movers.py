"""Motion: the path of the ego vehicle, and movers with constant speed along a line of the
street."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.lab.town.prototype import Prototype
from lidar_synth.lab.town.scene import PlacedObject, Pose, Scene
from lidar_synth.lab.town.street import Street


@dataclass(frozen=True)
class Mover:
    """A moving object (or one that waits) on a line of constant s or t.

    Args:
        shapes: its prototypes by phase of the stride; a single one for a vehicle.
        stride: metres travelled per cycle of the phases.
        along: True if it moves along s, False if it moves along t.
        at: the constant coordinate, metres.
        start: the changing coordinate at time 0, metres.
        direction: +1 or -1, the direction in which it faces.
        speed: m/s; 0 for one that waits.
        instance: its instance number.
        surfaces: the surface number of each slot.
        scale: the scale of its prototype.
    """

    shapes: tuple[Prototype, ...]
    stride: float
    along: bool
    at: float
    start: float
    direction: int
    speed: float
    instance: int
    surfaces: NDArray[np.int32]
    scale: float

    def place(self, time: float) -> tuple[float, float, float]:
        """Its s and t (metres) and its yaw relative to the street (radians) at a time in
        seconds."""
        moving = self.start + self.direction * self.speed * time
        yaw = (0.0 if self.along else np.pi / 2) + (
            np.pi if self.direction < 0 else 0.0
        )
        return (moving, self.at, yaw) if self.along else (self.at, moving, yaw)

    def shape(self, time: float) -> Prototype:
        """Its prototype at a time in seconds."""
        return self.shapes[
            int((abs(self.start) + self.speed * time) / self.stride * len(self.shapes))
            % len(self.shapes)
        ]


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
    near = np.flatnonzero(
        np.hypot(places[:, 0] - about[0], places[:, 1] - about[1]) < reach
    )
    lengths = [2.0 if len(movers[i].shapes) == 1 else 0.5 for i in near]
    s, t, yaw = places[near].T
    poses = scene.poses(s, t, yaw, lengths)
    return [
        PlacedObject(m.shape(time), pose, m.instance, m.surfaces, m.scale)
        for m, pose in zip((movers[i] for i in near), poses, strict=True)
    ]


def ego_place(street: Street, time: float) -> tuple[float, float, float]:
    """Street coordinates of the ego vehicle at a time in seconds, and its yaw (radians) relative to
    the street.

    The vehicle follows its lane with a small lateral drift, or turns in an arc into the right lane
    of a side street.
    """
    travelled = street.speed * time
    lane = street.lanes[0].t
    if street.turn is None:
        return travelled, float(lane + 0.15 * np.sin(0.11 * travelled)), 0.0
    crossing, side = street.turn
    sign = 2 * side - 1
    radius = (4.0, 8.0)[side]
    target = crossing.s + sign * crossing.half / 2
    angle = float(np.clip((travelled - (target - radius)) / radius, 0, np.pi / 2))
    beyond = max(0.0, travelled - (target - radius) - radius * np.pi / 2)
    s = min(travelled, target - radius) + radius * np.sin(angle)
    return (
        float(s),
        float(lane + sign * (radius * (1 - np.cos(angle)) + beyond)),
        sign * angle,
    )


def ego_pose(
    street: Street, scene: Scene, time: float, height: float, sway: NDArray[np.float64]
) -> Pose:
    """(4, 4) sensor to world at a time in seconds.

    Args:
        street, scene: the stretch on which it drives.
        time: seconds since it passed s = 0.
        height: height of the sensor above the ground, metres.
        sway: (roll, pitch) of the body on its suspension, radians.
    """
    pose = scene.poses(*ego_place(street, time), 4.0)
    roll, pitch = sway
    rolled = np.array(
        [(1, 0, 0), (0, np.cos(roll), -np.sin(roll)), (0, np.sin(roll), np.cos(roll))]
    )
    pitched = np.array(
        [
            (np.cos(pitch), 0, np.sin(pitch)),
            (0, 1, 0),
            (-np.sin(pitch), 0, np.cos(pitch)),
        ]
    )
    pose[:3, :3] = pose[:3, :3] @ pitched @ rolled
    pose[:3, 3] += height * pose[:3, 2]
    return pose
