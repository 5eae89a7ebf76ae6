"""Points to pixels: a z-buffer in numpy, so that a scan can be seen without a graphics card or a screen.

Every point is a disc as large as the patch of surface its beam stands for (the gap to the next beam grows with
range), the nearest disc owns a pixel, and eye-dome lighting (Boucheny 2009) shades by the depth of the
neighbouring pixels: a cloud has no surfaces or normals, and without it no shape.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.viz.colour import EMPTY, Rgb, Scale, point_values, scales

SAMPLES = 2
"""Samples per pixel and axis; their mean is the pixel."""


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from, in the scan's frame (x forward, y left, z up, metres).

    Args:
        eye: position.
        target: what the middle of the picture shows.
        up: which way is up in the picture.
        field: vertical field of view, degrees; or, where ``parallel``, the metres from bottom to top.
        parallel: orthographic, as a map is.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    field: float = 45.0
    parallel: bool = False

    def axes(self) -> NDArray[np.float64]:
        """(3, 3) unit vectors right, down and forward."""
        forward = np.subtract(self.target, self.eye).astype(np.float64)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def look(
        self, points: NDArray[np.floating], size: tuple[int, int]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Where points (N, 3) appear in a picture of ``size`` (width, height) pixels.

        Returns:
            (N, 2) pixel coordinates (x right, y down, from the upper left corner), (N,) depth in metres
            along the view (negative: behind the camera), (N,) pixels per metre there.
        """
        local = ((points - np.asarray(self.eye)) @ self.axes().T).astype(np.float32)
        depth = local[:, 2]
        if self.parallel:
            per_metre = np.full(len(local), size[1] / self.field, np.float32)
        else:
            focal = size[1] / 2 / np.tan(np.radians(self.field) / 2)
            per_metre = (focal / np.maximum(depth, 1e-3)).astype(np.float32)
        return local[:, :2] * per_metre[:, None] + np.array(size, np.float32) / 2, depth, per_metre


class Orbit(NamedTuple):
    """Where a camera stands around what it looks at; growing azimuths make a turntable.

    The usual view is from behind on the right and above.

    Args:
        azimuth: degrees clockwise from straight ahead; 180 = behind.
        elevation: degrees above the horizon.
        distance: metres from the target.
        field: vertical field of view, degrees.
        target: x, y, z in metres.
    """

    azimuth: float = 150.0
    elevation: float = 28.0
    distance: float = 42.0
    field: float = 42.0
    target: tuple[float, float, float] = (0.0, 0.0, -1.5)

    def camera(self) -> Camera:
        """The camera that stands there."""
        a, e = np.radians(self.azimuth), np.radians(self.elevation)
        away = self.distance * np.array([np.cos(a) * np.cos(e), -np.sin(a) * np.cos(e), np.sin(e)])
        x, y, z = (self.target + away).tolist()
        return Camera((x, y, z), self.target, field=self.field)


def bird(extent: float = 50.0) -> Camera:
    """A camera that sees ``extent`` metres to either side from above, ahead up."""
    return Camera((0.0, 0.0, 100.0), up=(1.0, 0.0, 0.0), field=2 * extent, parallel=True)


def _splat(
    pixels: NDArray[np.float32],
    depth: NDArray[np.float32],
    radius: NDArray[np.float32],
    colours: Rgb,
    size: tuple[int, int],
) -> tuple[Rgb, NDArray[np.float32]]:
    """Picture and depth buffer, (h, w, 3) and (h, w), inf where nothing is; the nearest disc owns a pixel."""
    width, height = size
    buffer = np.full(width * height, np.inf, np.float32)
    owner = np.full(width * height, -1, np.int64)
    column, row = np.floor(pixels).astype(np.int64).T
    steps = np.clip(np.rint(radius), 0, 6).astype(np.int64)
    for reach in np.unique(steps):
        chosen = np.flatnonzero(steps == reach)
        span = np.arange(-reach, reach + 1)
        for dy, dx in ((dy, dx) for dy in span for dx in span if dx * dx + dy * dy <= reach * reach + 0.5):
            x, y = column[chosen] + dx, row[chosen] + dy
            seen = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            index, disc = y[seen] * width + x[seen], chosen[seen]
            np.minimum.at(buffer, index, depth[disc])
            front = depth[disc] == buffer[index]
            owner[index[front]] = disc[front]
    picture = np.tile(EMPTY, (width * height, 1))
    picture[owner >= 0] = colours[owner[owner >= 0]]
    return picture.reshape(height, width, 3), buffer.reshape(height, width)


def _shade(picture: Rgb, buffer: NDArray[np.float32], strength: float = 40.0) -> Rgb:
    """Eye-dome lighting: a pixel darkens with how far its neighbours stand in front of it, in log depth."""
    filled = np.isfinite(buffer)
    logs = np.log2(np.where(filled, np.maximum(buffer, 1e-3), 1.0)).astype(np.float32)
    logs[~filled] = np.inf
    behind = np.zeros(buffer.shape, np.float32)
    for reach in (1, 3):
        padded = np.pad(logs, reach, constant_values=np.inf)
        for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            neighbour = padded[reach + dy :, reach + dx :][: buffer.shape[0], : buffer.shape[1]]
            # A step of more than 2 % is an edge, whatever its height; an empty neighbour casts no shade.
            behind += np.clip(np.where(filled, logs, 0) - neighbour, 0, 0.03)
    light = np.where(filled, np.exp(-strength * behind / 8), 1)
    return np.rint(EMPTY + (picture.astype(np.float32) - EMPTY) * light[..., None]).astype(np.uint8)


def _lines(
    picture: Rgb,
    buffer: NDArray[np.float32],
    segments: NDArray[np.floating],
    camera: Camera,
    colour: tuple[int, int, int],
    opacity: float = 1.0,
) -> None:
    """Draws segments (S, 2, 3) into the picture, faint where the scan hides them."""
    height, width = buffer.shape
    ends, depth, _ = camera.look(segments.reshape(-1, 3), (width, height))
    before = (depth > 0.1).reshape(-1, 2)
    length = np.abs(np.diff(ends.reshape(-1, 2, 2), axis=1)).max((1, 2))
    counts = np.where(before.any(1), np.clip(np.ceil(2 * length), 2, 8 * width), 0).astype(np.int64)
    which = np.repeat(np.arange(len(segments)), counts)
    along = (np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)) / np.maximum(counts[which] - 1, 1)
    points = segments[which, 0] * (1 - along[:, None]) + segments[which, 1] * along[:, None]
    pixels, depth, _ = camera.look(points, (width, height))
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        x, y = np.floor(pixels).astype(np.int64).T + np.array([[dx], [dy]])
        seen = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (depth > 0.1)
        clear = depth[seen] <= buffer[y[seen], x[seen]] + 0.15
        strength = np.zeros(buffer.shape, np.float32)
        np.maximum.at(strength, (y[seen], x[seen]), np.where(clear, opacity, 0.25 * opacity).astype(np.float32))
        row, column = np.nonzero(strength)
        share = strength[row, column, None]
        picture[row, column] = picture[row, column] * (1 - share) + np.array(colour) * share


EDGES = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)])
"""The 12 edges of a box, by the order of ``Boxes.corners``."""


def box_segments(boxes: Boxes) -> NDArray[np.float32]:
    """(13 M, 2, 3) edges of the boxes, and for each a line on its roof from the middle to the front."""
    corners = boxes.corners()
    roof = corners[:, 4:].mean(1)
    nose = (corners[:, 4] + corners[:, 7]) / 2
    heading = np.stack([roof, nose], 1)
    return np.concatenate([corners[:, EDGES].reshape(-1, 2, 3), heading]).astype(np.float32)


def ring_segments(scan: Scan) -> NDArray[np.float32]:
    """(S, 2, 3) circles every 10 m on the ground, so that a picture has a measure."""
    near = scan.points[np.linalg.norm(scan.points[:, :2], axis=1) < 20, 2]
    ground = float(np.percentile(near, 5)) if len(near) else 0.0
    turn = np.linspace(0, 2 * np.pi, 97)
    circle = np.stack([np.cos(turn), np.sin(turn)], -1)
    rings = [np.c_[radius * circle, np.full(len(turn), ground)] for radius in range(10, 60, 10)]
    return np.concatenate([np.stack([ring[:-1], ring[1:]], 1) for ring in rings]).astype(np.float32)


def render(
    scan: Scan,
    by: str = "height",
    *,
    camera: Camera | None = None,
    size: tuple[int, int] = (1280, 720),
    scale: Scale | None = None,
    boxes: bool = True,
    rings: bool = True,
) -> Rgb:
    """A picture of a scan's points.

    Args:
        scan: what to show.
        by: the quantity that colours the points, one of ``colour.VALUES``.
        camera: where from; that of ``Orbit()`` without it.
        size: width and height in pixels.
        scale: the meaning of the colours; that of this scan alone without it.
        boxes: draw the scan's boxes, with a line to each front.
        rings: draw circles on the ground, 10 m apart.

    Returns:
        (height, width, 3) uint8.

    Raises:
        ConfigError: when the scan does not know the quantity.
    """
    camera = camera or Orbit().camera()
    values = point_values(scan, by)
    colours = (scale or scales([scan])[by])(values)
    fine = (size[0] * SAMPLES, size[1] * SAMPLES)
    pixels, depth, per_metre = camera.look(scan.points, fine)
    kept = depth > 0.1
    gap = 0.015 + 0.003 * np.linalg.norm(scan.points[kept], axis=1)
    picture, buffer = _splat(pixels[kept], depth[kept], gap * per_metre[kept], colours[kept], fine)
    picture = _shade(picture, buffer)
    if rings:
        _lines(picture, buffer, ring_segments(scan), camera, (150, 160, 180), 0.35)
    if boxes and scan.boxes is not None and len(scan.boxes):
        _lines(picture, buffer, box_segments(scan.boxes), camera, (255, 255, 255), 0.9)
    mean: NDArray[np.float64] = picture.reshape(size[1], SAMPLES, size[0], SAMPLES, 3).mean((1, 3))
    return np.rint(mean).astype(np.uint8)
