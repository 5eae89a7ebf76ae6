"""Software renderer for points: a z-buffer in numpy, which needs no graphics card and no screen.

Every point is drawn as a disc whose size grows with range, like the gap between beams, so that
surfaces look closed. The nearest disc fills a pixel. Eye-dome lighting (Boucheny 2009) shades by
the depth of neighbouring pixels, which makes shapes visible although points have no normals.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidar_synth.geometry import Boxes, Scan
from lidar_synth.geometry.arrays import Float32Array
from lidar_synth.viz.scales import EMPTY, Rgb, Scale, make_scales, point_values

SAMPLES = 2
"""Samples per pixel along each axis, averaged for antialiasing."""


@dataclass(frozen=True)
class Camera:
    """A camera in the scan's frame (x forward, y left, z up, metres).

    Args:
        eye: position of the camera.
        target: the point at the centre of the picture.
        up: the direction that is up in the picture; for a camera that looks along it, another one,
            by default straight ahead.
        field: vertical field of view in degrees; with ``parallel``, the height of the picture in
            metres.
        parallel: orthographic projection instead of perspective.
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
        if not right.any():
            right = np.cross(forward, np.roll(self.up, 1))
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def look(
        self, points: NDArray[np.floating], size: tuple[int, int]
    ) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Project points (N, 3) into a picture of ``size`` (width, height) pixels.

        Returns:
            (N, 2) pixel coordinates (x right, y down, from the upper left corner), (N,) depth in
            metres along the viewing direction (negative: behind the camera), (N,) pixels per metre
            at that depth.
        """
        local = ((points - np.asarray(self.eye)) @ self.axes().T).astype(np.float32)
        depth = local[:, 2]
        if self.parallel:
            per_metre = np.full(len(local), size[1] / self.field, np.float32)
        else:
            focal = size[1] / 2 / np.tan(np.radians(self.field) / 2)
            per_metre = (focal / np.maximum(depth, 1e-3)).astype(np.float32)
        return (
            local[:, :2] * per_metre[:, None] + np.array(size, np.float32) / 2,
            depth,
            per_metre,
        )


class Orbit(NamedTuple):
    """A camera position on a sphere around a target; increasing azimuths give a turntable
    animation.

    The default view is from behind, slightly to the right, and above.

    Args:
        azimuth: of the camera as seen from the target, degrees clockwise from straight ahead; 180 =
            behind.
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
        """The perspective camera at this position."""
        a = np.radians(self.azimuth)
        e = np.radians(self.elevation)
        away = self.distance * np.array(
            [np.cos(a) * np.cos(e), -np.sin(a) * np.cos(e), np.sin(e)]
        )
        x, y, z = (self.target + away).tolist()
        return Camera((x, y, z), self.target, field=self.field)


def bird(extent: float = 50.0) -> Camera:
    """An orthographic camera from above that shows ``extent`` metres on each side; straight ahead
    is up."""
    return Camera(
        (0.0, 0.0, 100.0), up=(1.0, 0.0, 0.0), field=2 * extent, parallel=True
    )


def _splat(
    pixels: Float32Array,
    depth: Float32Array,
    radius: Float32Array,
    colours: Rgb,
    size: tuple[int, int],
) -> tuple[Rgb, Float32Array]:
    """Picture (h, w, 3) and depth buffer (h, w), inf = empty, of points drawn as discs; the nearest
    disc wins."""
    width, height = size
    buffer = np.full(width * height, np.inf, np.float32)
    owner = np.full(width * height, -1, np.int64)
    column, row = np.floor(pixels).astype(np.int64).T
    steps = np.clip(np.rint(radius), 0, 6).astype(np.int64)
    for reach in np.unique(steps):
        chosen = np.flatnonzero(steps == reach)
        span = np.arange(-reach, reach + 1)
        limit = reach * reach + 0.5
        disc_offsets = [
            (dy, dx) for dy in span for dx in span if dx * dx + dy * dy <= limit
        ]
        for dy, dx in disc_offsets:
            x = column[chosen] + dx
            y = row[chosen] + dy
            visible = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            index = y[visible] * width + x[visible]
            disc = chosen[visible]
            np.minimum.at(buffer, index, depth[disc])
            front = depth[disc] == buffer[index]
            owner[index[front]] = disc[front]
    picture = np.tile(EMPTY, (width * height, 1))
    picture[owner >= 0] = colours[owner[owner >= 0]]
    return picture.reshape(height, width, 3), buffer.reshape(height, width)


def _shade(picture: Rgb, buffer: Float32Array, strength: float = 40.0) -> Rgb:
    """Eye-dome lighting: darken a pixel by the log-depth differences to neighbours in front of
    it."""
    filled = np.isfinite(buffer)
    logs = np.log2(np.where(filled, np.maximum(buffer, 1e-3), 1.0)).astype(np.float32)
    logs[~filled] = np.inf
    behind = np.zeros(buffer.shape, np.float32)
    for reach in (1, 3):
        padded = np.pad(logs, reach, constant_values=np.inf)
        for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            moved = padded[reach + dy :, reach + dx :]
            neighbour = moved[: buffer.shape[0], : buffer.shape[1]]
            # Steps of more than 2 % in depth all count as edges; an empty neighbour does not
            # darken.
            behind += np.clip(np.where(filled, logs, 0) - neighbour, 0, 0.03)
    light = np.where(filled, np.exp(-strength * behind / 8), 1)
    return np.rint(
        EMPTY + (picture.astype(np.float32) - EMPTY) * light[..., None]
    ).astype(np.uint8)


def _lines(
    picture: Rgb,
    buffer: Float32Array,
    segments: NDArray[np.floating],
    camera: Camera,
    colour: tuple[int, int, int],
    opacity: float = 1.0,
) -> None:
    """Draw segments (S, 2, 3) into the picture, faint where points of the scan occlude them."""
    height, width = buffer.shape
    ends, depth, _ = camera.look(segments.reshape(-1, 3), (width, height))
    in_front = (depth > 0.1).reshape(-1, 2)
    length = np.abs(np.diff(ends.reshape(-1, 2, 2), axis=1)).max((1, 2))
    counts = np.where(
        in_front.any(1), np.clip(np.ceil(2 * length), 2, 8 * width), 0
    ).astype(np.int64)
    which = np.repeat(np.arange(len(segments)), counts)
    along = (
        np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    ) / np.maximum(counts[which] - 1, 1)
    points = (
        segments[which, 0] * (1 - along[:, None]) + segments[which, 1] * along[:, None]
    )
    pixels, depth, _ = camera.look(points, (width, height))
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        x, y = np.floor(pixels).astype(np.int64).T + np.array([[dx], [dy]])
        visible = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (depth > 0.1)
        clear = depth[visible] <= buffer[y[visible], x[visible]] + 0.15
        strength = np.zeros(buffer.shape, np.float32)
        np.maximum.at(
            strength,
            (y[visible], x[visible]),
            np.where(clear, opacity, 0.25 * opacity).astype(np.float32),
        )
        row, column = np.nonzero(strength)
        share = strength[row, column, None]
        picture[row, column] = (
            picture[row, column] * (1 - share) + np.array(colour) * share
        )


EDGES = np.array(
    [
        (0, 1),
        (1, 2),
        (2, 3),
        (3, 0),
        (4, 5),
        (5, 6),
        (6, 7),
        (7, 4),
        (0, 4),
        (1, 5),
        (2, 6),
        (3, 7),
    ]
)
"""The 12 edges of a box, as indices of ``Boxes.corners``."""


def box_segments(boxes: Boxes) -> Float32Array:
    """(13 M, 2, 3) edges of the boxes, and for each box a line on its top from the centre to the
    front."""
    corners = boxes.corners()
    roof = corners[:, 4:].mean(1)
    nose = (corners[:, 4] + corners[:, 7]) / 2
    heading = np.stack([roof, nose], 1)
    return np.concatenate([corners[:, EDGES].reshape(-1, 2, 3), heading]).astype(
        np.float32
    )


def ring_segments(scan: Scan) -> Float32Array:
    """(S, 2, 3) circles on the ground every 10 m, which show distances."""
    near = scan.points[np.linalg.norm(scan.points[:, :2], axis=1) < 20, 2]
    ground = float(np.percentile(near, 5)) if len(near) else 0.0
    turn = np.linspace(0, 2 * np.pi, 97)
    circle = np.stack([np.cos(turn), np.sin(turn)], -1)
    rings = [
        np.c_[radius * circle, np.full(len(turn), ground)]
        for radius in range(10, 60, 10)
    ]
    return np.concatenate(
        [np.stack([ring[:-1], ring[1:]], 1) for ring in rings]
    ).astype(np.float32)


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
    """Render the points of a scan.

    Args:
        scan: the scan to show.
        by: the quantity that colours the points, one of ``scales.VALUES``.
        camera: the camera; by default that of ``Orbit()``.
        size: width and height in pixels.
        scale: the colour scale; by default that of this scan alone.
        boxes: whether to draw the scan's boxes, with a line to the front of each.
        rings: whether to draw circles on the ground, 10 m apart.

    Returns:
        (height, width, 3) uint8.

    Raises:
        ConfigError: if the scan does not have the quantity.
    """
    camera = camera or Orbit().camera()
    values = point_values(scan, by)
    colours = (scale or make_scales([scan])[by])(values)
    fine = (size[0] * SAMPLES, size[1] * SAMPLES)
    pixels, depth, per_metre = camera.look(scan.points, fine)
    in_front = depth > 0.1
    gap = 0.015 + 0.003 * np.linalg.norm(scan.points[in_front], axis=1)
    picture, buffer = _splat(
        pixels[in_front],
        depth[in_front],
        gap * per_metre[in_front],
        colours[in_front],
        fine,
    )
    picture = _shade(picture, buffer)
    if rings:
        _lines(picture, buffer, ring_segments(scan), camera, (150, 160, 180), 0.35)
    if boxes and scan.boxes is not None and len(scan.boxes):
        _lines(picture, buffer, box_segments(scan.boxes), camera, (255, 255, 255), 0.9)
    mean: NDArray[np.float64] = picture.reshape(
        size[1], SAMPLES, size[0], SAMPLES, 3
    ).mean((1, 3))
    return np.rint(mean).astype(np.uint8)
