"""Augmentations of a scan: points, labels and boxes together.

An augmentation is ``(scan, rng) -> scan``: a pure function of its two arguments, which never
changes its input. ``functools.partial`` sets its options, and ``Compose`` makes one augmentation of
several.

``yaw``, the flips and ``scale`` move points and boxes together, and remove the scan's pose and
camera image.

Example:
    >>> import numpy as np
    >>> from lidar_synth import Town
    >>> from lidar_synth.labels.augment import yaw
    >>> scan = Town(seed=0, scans=1)[0]
    >>> turned = yaw(scan, np.random.default_rng(0), limit=45)
    >>> np.array_equal(turned.label, scan.label)
    True
    >>> np.array_equal(turned.boxes.values, scan.boxes.values)
    False
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError
from lidar_synth.geometry import Boxes, Scan
from lidar_synth.geometry.projection import locate
from lidar_synth.labels.boxes import move_boxes, turn_boxes, turn_points
from lidar_synth.labels.own import check_share

Augmentation = Callable[[Scan, np.random.Generator], Scan]


def yaw(scan: Scan, rng: np.random.Generator, limit: float = 180.0) -> Scan:
    """Rotate the scan about the vertical axis by a random angle of up to ``limit`` degrees to
    either side."""
    check_share("limit", limit, 180)
    angle = float(rng.uniform(-limit, limit))
    return rotate_scan(scan, float(np.radians(angle))).noted("yaw", degrees=angle)


def flip_x(scan: Scan, rng: np.random.Generator, chance: float = 0.5) -> Scan:
    """Mirror front and back with probability ``chance``."""
    if rng.random() >= check_share("chance", chance):
        return scan
    return mirror_scan(scan, "x").noted("flip_x")


def flip_y(scan: Scan, rng: np.random.Generator, chance: float = 0.5) -> Scan:
    """Mirror left and right with probability ``chance``."""
    if rng.random() >= check_share("chance", chance):
        return scan
    return mirror_scan(scan, "y").noted("flip_y")


def scale(
    scan: Scan, rng: np.random.Generator, low: float = 0.95, high: float = 1.05
) -> Scan:
    """Multiply all lengths by a random factor between ``low`` and ``high``."""
    if not 0 < low <= high < np.inf:
        raise ConfigError(f"low={low}, high={high}", "0 < low <= high")
    factor = float(rng.uniform(low, high))
    return scale_scan(scan, factor).noted("scale", factor=factor)


def jitter(
    scan: Scan,
    rng: np.random.Generator,
    spread: float = 0.01,
    reflectance: float = 0.02,
) -> Scan:
    """Add noise along the rays and to the reflectance; a return that would enter or leave a box is
    not moved.

    Args:
        scan: N points.
        rng: source of the noise.
        spread: standard deviation of the range, metres; the noise is clipped at three standard
            deviations.
        reflectance: standard deviation of the reflectance, which stays in [0, 1].
    """
    if spread < 0 or reflectance < 0:
        raise ConfigError(f"spread={spread}, reflectance={reflectance}", "0 or more")
    noise = np.clip(rng.standard_normal((2, len(scan)), np.float32), -3, 3)
    distance = np.maximum(np.linalg.norm(scan.points, axis=1), 1e-3)
    points = scan.points * (1 + spread * noise[0] / distance)[:, None]
    if scan.boxes is not None:
        crossed = (scan.boxes.contain(scan.points) != scan.boxes.contain(points)).any(0)
        points[crossed] = scan.points[crossed]
    brightness = np.clip(scan.reflectance + reflectance * noise[1], 0, 1)
    return replace(
        scan.noted("jitter", spread=spread, reflectance=reflectance),
        points=points.astype(np.float32),
        reflectance=brightness.astype(np.float32),
    )


def drop_reflectance(scan: Scan, rng: np.random.Generator, chance: float = 1.0) -> Scan:
    """Set the reflectance to 0 with probability ``chance``: a network cannot tell domains by it.

    Apply it to real and synthetic scans alike, in training and, with ``chance=1``, at inference.
    """
    if rng.random() >= check_share("chance", chance):
        return scan
    dark = np.zeros_like(scan.reflectance)
    return replace(scan.noted("drop_reflectance"), reflectance=dark)


def beam_drop(scan: Scan, rng: np.random.Generator, share: float = 0.25) -> Scan:
    """Drop entire rings, at most ``share`` of the sensor's beams.

    The ring of a point is ``scan.ring``, or its row in the sensor's range image if that is not set.
    """
    rows, columns = scan.sensor.shape
    most = round(check_share("share", share) * rows)
    dropped = rng.choice(rows, rng.integers(most + 1), replace=False)
    row = (
        locate(scan.points, scan.sensor).cell // columns
        if scan.ring is None
        else scan.ring
    )
    scan = scan.noted("beam_drop", beams=sorted(dropped.tolist()))
    return _subset(scan, ~np.isin(row, dropped))


def range_drop(
    scan: Scan, rng: np.random.Generator, share: float = 0.3, power: float = 2.0
) -> Scan:
    """Drop returns with a probability that increases with their range.

    Args:
        scan: N points.
        rng: source of the random numbers.
        share: probability that a return at ``range_max`` is dropped.
        power: the probability is proportional to range / range_max to this power.
    """
    if not power >= 0:
        raise ConfigError(f"power={power}", "0 or more")
    far = np.minimum(np.linalg.norm(scan.points, axis=1) / scan.sensor.range_max, 1)
    kept = rng.random(len(scan)) >= check_share("share", share) * far**power
    return _subset(scan.noted("range_drop", share=share, power=power), kept)


def rotate_scan(scan: Scan, angle: float) -> Scan:
    """Rotate the scan about the vertical axis, counter-clockwise, by an angle in radians."""
    boxes = None if scan.boxes is None else turn_boxes(scan.boxes, angle)
    return _placed(scan, turn_points(scan.points, angle), boxes)


def mirror_scan(scan: Scan, axis: Literal["x", "y"]) -> Scan:
    """Mirror the scan: change the sign of x (front and back) or of y (left and right)."""
    if axis not in ("x", "y"):
        raise ConfigError(f"axis={axis!r}", "'x' or 'y'")
    column = "xy".index(axis)
    boxes = None
    points = scan.points.copy()
    points[:, column] *= -1
    if scan.boxes is not None:
        values = scan.boxes.values.copy()
        values[:, column] *= -1
        values[:, 6] = np.pi * (axis == "x") - values[:, 6]
        boxes = move_boxes(scan.boxes, values)
    return _placed(scan, points, boxes)


def scale_scan(scan: Scan, factor: float) -> Scan:
    """Multiply all lengths of the scan by a factor."""
    boxes = None
    if scan.boxes is not None:
        values = scan.boxes.values.copy()
        values[:, :6] *= factor
        boxes = move_boxes(scan.boxes, values)
    return _placed(scan, scan.points * np.float32(factor), boxes)


def _placed(scan: Scan, points: NDArray[np.float32], boxes: Boxes | None) -> Scan:
    """The scan with moved points (N, 3) and boxes, which its pose and image no longer fit."""
    return replace(scan, points=points, boxes=boxes, pose=None, image_path=None)


def _subset(scan: Scan, keep: NDArray[np.bool_]) -> Scan:
    """Keep some of the points, and drop the boxes that lose all of their points."""
    if scan.boxes is None:
        return scan[keep]
    inside = scan.boxes.contain(scan.points)
    return replace(
        scan[keep], boxes=scan.boxes[~inside.any(1) | inside[:, keep].any(1)]
    )
