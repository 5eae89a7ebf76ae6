"""Turns of a made-up sensor between walls and boxes, with the time and the true beam and firing of
every point."""

from dataclasses import dataclass

import numpy as np

from lidar_synth.geometry.deskew import Trajectory, deskew
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import load_sensor

BEAMS = tuple(
    np.r_[np.linspace(8, -4, 9), -5.5, -7.5, -9.0, -11.5, -14.0, -17.0, -21.0].tolist()
)
"""Elevations of 16 beams, degrees, unevenly spaced."""

WALLS = 300
"""Number of walls around the sensor."""

DURATION = 0.1
"""Seconds of a turn."""


@dataclass
class Turned:
    """A scan, and where its points come from."""

    scan: Scan
    ring: np.ndarray
    firing: np.ndarray


def turned(
    elevations: tuple[float, ...] = BEAMS,
    heights: tuple[float, ...] | None = None,
    azimuths: tuple[float, ...] | None = None,
    firings: int = 1000,
    encoder: int | None = None,
    seed: int = 0,
) -> Turned:
    """One turn, point by point in the order of time; one in ten returns is missing.

    Args:
        elevations: degrees, highest first.
        heights: metres above the origin.
        azimuths: degrees, clockwise.
        firings: per turn.
        encoder: steps of a turn to which azimuths are rounded, while the rotation speed varies by
            half a per cent.
        seed: of the scene.
    """
    rng = np.random.default_rng(seed)
    rows = len(elevations)
    firing = np.repeat(np.arange(firings), rows)
    ring = np.tile(np.arange(rows), firings)
    part = (firing + 0.5) / firings
    if encoder:
        part = part + 0.0008 * np.sin(2 * np.pi * (part + rng.random()))
        part = np.floor(part * encoder) / encoder
    head = 2 * np.pi * (part - 0.5)
    azimuth = head + (np.radians(azimuths)[ring] if azimuths is not None else 0)
    elevation = np.radians(elevations)[ring]
    height = np.asarray(heights)[ring] if heights is not None else np.zeros(len(ring))
    distance = _distances(azimuth, elevation, height, rng)
    rho = distance * np.cos(elevation)
    points = np.stack(
        [
            rho * np.cos(azimuth),
            -rho * np.sin(azimuth),
            height + distance * np.sin(elevation),
        ],
        1,
    )
    kept = (distance < 100) & (rng.random(len(ring)) < 0.9)
    scan = Scan(
        points[kept].astype(np.float32),
        (rng.integers(0, 256, kept.sum()) / 255).astype(np.float32),
        load_sensor("town"),
        time=(DURATION * (firing[kept] / firings - 0.5)).astype(np.float32),
        id=f"turn-{seed}",
    )
    return Turned(scan, ring[kept], firing[kept])


def _distances(
    azimuth: np.ndarray,
    elevation: np.ndarray,
    height: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Level ground 1.7 m below the origin, and slanted walls whose distance changes every degree or
    so."""
    sector = azimuth / (2 * np.pi) % 1.0 * WALLS
    number = sector.astype(int) % WALLS
    near = np.exp(rng.uniform(np.log(4), np.log(70), WALLS))
    wall = near[number] * (1 + rng.uniform(-0.5, 0.5, WALLS)[number] * (sector % 1))
    wall = wall / np.cos(elevation)
    with np.errstate(divide="ignore"):
        ground = np.where(elevation < 0, (1.7 + height) / -np.sin(elevation), np.inf)
    return np.minimum(wall, ground)


def driving(speed: float, turn_rate: float = 0.0) -> Trajectory:
    """A car that drives forward, poses every tenth of a second."""
    times = np.arange(-2, 3) * DURATION
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for pose, time in zip(poses, times, strict=True):
        c = np.cos(turn_rate * time)
        s = np.sin(turn_rate * time)
        pose[:2, :2], pose[0, 3] = [[c, -s], [s, c]], speed * time
    return Trajectory(times, poses)


def compensated(scan: Scan, speed: float, turn_rate: float = 0.0) -> Scan:
    """The scan as a dataset publishes it that compensates motion."""
    return deskew(scan, driving(speed, turn_rate))
