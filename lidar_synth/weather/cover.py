"""Water and dirt near a sensor: spray behind vehicles, and dirt on the cover."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Scan
from lidar_synth.weather.corruption import Change, Values, require_between
from lidar_synth.weather.signal import SignalLoss, overlap, ranges_of

VEHICLES = "Car", "Van", "Truck", "Tram"
PLUME = 12.0, 0.5, 1.0
"""Length of the plume of spray behind a vehicle, how much wider it is than the vehicle,
and its share of the vehicle's height; metres."""
FARTHEST = 50.0
"""Distance from the sensor up to which plumes return pulses, metres."""
SPRAY = 0.05
"""Reflectance of spray, drops of water that overlap."""
OWN = np.array([[0.0, 0.0, -0.9, 4.0, 1.8, 1.6, 0.0]], np.float32)
"""The box of the vehicle that carries the sensor."""
SPOT = 0.06
"""Standard deviation of a spot of dirt, radians."""
THICKNESS = 4.0
"""Optical thickness of dirt for each standard deviation above the edge of a spot."""
CELL = 0.02
"""Radians between the directions for which the cover is drawn."""


@dataclass(frozen=True)
class Spray(SignalLoss):
    """Spray that the wheels of vehicles throw up from a wet road, behind every box of
    ``VEHICLES`` (``Car``, ``Van``, ``Truck``, ``Tram``) and behind the sensor's own vehicle.
    Buses have none where their boxes are ``Misc``: in the town, PandaSet and KITTI-360.

    Args:
        extinction: of the plumes, 1 / m.

    Raises:
        ConfigError: on an extinction outside 0.001 to 10 / m.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import Spray
        >>> scan = Town(seed=0, scans=1)[0]
        >>> wet = Spray(extinction=0.3)(scan, np.random.default_rng(0))
        >>> bool((wet.cause == 1).any())
        True
    """

    extinction: float
    name = "spray"
    SEVERE = {"extinction": 0.05}, {"extinction": 0.15}, {"extinction": 0.4}

    def __post_init__(self) -> None:
        require_between("extinction", self.extinction, 1e-3, 10)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        distance = ranges_of(scan)
        left = np.ones(len(scan), np.float32)
        soft = np.zeros(len(scan), np.float32)
        place = distance.copy()
        for plume in place_plumes(scan):
            first, last, rays = cross_box(scan.points, distance, plume)
            depth = last - first
            # The first drops on the ray return the most, as in the fog.
            reach = rng.standard_exponential(len(rays), np.float32) / self.extinction
            hit = reach < depth
            where = first + np.minimum(reach, depth)
            seen = SPRAY * overlap(where) * left[rays] / np.maximum(where, 0.1) ** 2
            nearer = hit & (seen > soft[rays])
            soft[rays[nearer]] = seen[nearer]
            place[rays[nearer]] = where[nearer]
            left[rays] *= np.exp(-2 * self.extinction * depth)
        return self.strongest(scan, distance, left, soft, place, rng)


def place_plumes(scan: Scan) -> NDArray[np.float32]:
    """(M, 7) boxes of spray behind vehicles, the nearest first."""
    vehicles = OWN
    if scan.boxes is not None:
        named = np.isin(scan.boxes.names, VEHICLES)
        vehicles = np.concatenate([OWN, scan.boxes.values[named]])
    length, wider, high = PLUME
    plumes = vehicles.copy()
    back = (vehicles[:, 3] + length) / 2
    plumes[:, 0] -= back * np.cos(vehicles[:, 6])
    plumes[:, 1] -= back * np.sin(vehicles[:, 6])
    plumes[:, 3] = length
    plumes[:, 4] += wider
    plumes[:, 5] *= high
    away = np.linalg.norm(plumes[:, :2], axis=1)
    return plumes[np.argsort(away)][: (away < FARTHEST).sum()]


def cross_box(
    points: Values, distance: Values, box: NDArray[np.float32]
) -> tuple[Values, Values, NDArray[np.int64]]:
    """Where the rays from the sensor to the points go through a box.

    Args:
        points: (N, 3) metres.
        distance: (N,) of them.
        box: (7,) as of ``Boxes``.

    Returns:
        (K,) metres at which K rays enter and leave it, and (K,) the numbers of the points.
    """
    centre = box[:3]
    half = box[3:6] / 2
    # If the sensor is outside the sphere through the corners, rays beside the sphere miss the box.
    outside = float(centre @ centre - half @ half)
    tangent = np.float32(np.sqrt(max(outside, 0)))
    rays = np.flatnonzero((points @ centre >= distance * tangent) | (outside < 0))
    c = np.cos(box[6])
    s = np.sin(box[6])
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
    direction = turn.T @ points[rays].T / distance[rays]
    direction[direction == 0] = 1e-9
    start = centre @ turn
    before = (start - half)[:, None] / direction
    behind = (start + half)[:, None] / direction
    first = np.maximum(np.minimum(before, behind).max(0), 0)
    last = np.minimum(np.maximum(before, behind).min(0), distance[rays])
    met = last > first
    return first[met], last[met], rays[met]


@dataclass(frozen=True)
class Dirt(SignalLoss):
    """Dirt on the sensor's cover: spots that let less of the pulse through, or nothing.

    Args:
        share: of the cover that is dirty, in [0, 1].

    Raises:
        ConfigError: on another share.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Town
        >>> from lidar_synth.weather import Dirt
        >>> scan = Town(seed=0, scans=1)[0]
        >>> 0.5 < len(Dirt(share=0.2)(scan, np.random.default_rng(0))) / len(scan) < 1
        True
    """

    share: float
    name = "dirt"
    SEVERE = {"share": 0.05}, {"share": 0.15}, {"share": 0.4}

    def __post_init__(self) -> None:
        require_between("share", self.share, 0, 1)

    def change(self, scan: Scan, rng: np.random.Generator) -> Change:
        distance = ranges_of(scan)
        thickness = draw_dirt(self.share, rng)
        rows, columns = thickness.shape
        x, y, z = np.ascontiguousarray(scan.points.T)
        column = (np.arctan2(y, x) / (2 * np.pi) + 0.5) * columns
        row = (z / distance + 1) / 2 * rows
        cell = row.astype(np.int32).clip(0, rows - 1) * columns
        cell += column.astype(np.int32).clip(0, columns - 1)
        # The pulse passes twice.
        left = np.exp(-2 * thickness.ravel()[cell])
        return self.attenuate(scan, distance, left, rng)


def draw_dirt(share: float, rng: np.random.Generator) -> Values:
    """(H, W) optical thickness of dirt by the sine of the elevation, from -1 to 1, and the
    azimuth: where smooth random values are above their quantile of 1 - ``share``."""
    rows = round(2 / CELL)
    columns = round(2 * np.pi / CELL)
    frequency = np.hypot(
        np.fft.fftfreq(rows, CELL)[:, None], np.fft.rfftfreq(columns, CELL)
    )
    noise = np.fft.rfft2(rng.standard_normal((rows, columns)))
    smooth = np.exp(-2 * (np.pi * SPOT * frequency) ** 2)
    values = np.fft.irfft2(noise * smooth, (rows, columns))
    above = values - np.quantile(values, 1 - share)
    thickness = np.maximum(above, 0) * THICKNESS / values.std()
    return np.asarray(thickness, np.float32)
