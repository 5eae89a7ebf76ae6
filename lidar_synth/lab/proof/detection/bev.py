"""Bird's-eye view: from a scan to the input and the targets of the network, and from its output
back to boxes.

The input is occupancy in slices of height (as PIXOR's, Yang et al. 2018), with reflectance and the
number of returns. The targets are those of CenterPoint (Yin et al. 2021), with the doubled yaw: a
box that points backwards has the same footprint, and few labelled boxes do not teach front from
back.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.geometry.arrays import Float32Array, Int64Array
from lidar_synth.lab.proof.detection.boxes import CLASSES

REACH = 51.2
"""Metres from the sensor to each of the four sides of the view."""
CELL = 0.2
"""Side of an input cell, metres."""
LOW = -4.0
SLICE = 0.3
SLICES = 20
"""Lowest height above the sensor, and height and number of the slices; metres."""
CELLS = round(2 * REACH / CELL)
CHANNELS = 4 * (SLICES + 2)
"""Of the input: 2 x 2 cells side by side are one pixel."""
REGRESSED = 8
"""Offset (2) in pixels of the output, height of the centre, logarithm of the size (3), cosine and
sine of 2 yaw."""
LOGARITHM = np.minimum(40 * np.log2(1 + np.arange(100)), 255).astype(np.uint8)
"""The value of a cell by its number of returns."""
APART = (1.2, 0.4, 0.7)
"""Minimum distance of two boxes of a class, metres."""


class Target(NamedTuple):
    """What the network is to answer for a view of n x n pixels.

    Args:
        heat: (classes, n, n) from 0 to 1, 1 at the centre of a box.
        values: (REGRESSED, n, n), known around centres.
        weight: (n, n) of the values; 0 away from boxes.
    """

    heat: Tensor
    values: Tensor
    weight: Tensor


@dataclass(frozen=True)
class Found:
    """Detected boxes: (D, 7) boxes as ``Boxes.values``, (D,) scores from 0 to 1, (D,) classes."""

    boxes: Float32Array
    scores: Float32Array
    classes: Int64Array


def view(
    points: Float32Array,
    reflectance: Float32Array,
) -> Tensor:
    """(n, n, CHANNELS) uint8: a scan of N points from above, x along the first axis."""
    image = np.zeros((CELLS * CELLS, SLICES + 2), np.uint8)
    count = np.zeros(CELLS * CELLS, np.int32)
    _fill(image, count, points, reflectance)
    image[:, SLICES + 1] = LOGARITHM[np.minimum(count, len(LOGARITHM) - 1)]
    return torch.from_numpy(image).view(CELLS // 2, CELLS // 2, CHANNELS)


@numba.njit(cache=True)
def _fill(image, count, points, reflectance):  # type: ignore[no-untyped-def]
    """Set the slices and a reflectance of every cell that has returns, and count them."""
    for k in range(len(points)):
        x = (points[k, 0] + REACH) / CELL
        y = (points[k, 1] + REACH) / CELL
        height = (points[k, 2] - LOW) / SLICE
        if 0 <= x < CELLS and 0 <= y < CELLS and 0 <= height < SLICES:
            i = int(x)
            j = int(y)
            block = i // 2 * (CELLS // 2) + j // 2
            cell = block * 4 + i % 2 * 2 + j % 2
            image[cell, int(height)] = 255
            image[cell, SLICES] = int(reflectance[k] * 255)  # of any of its returns
            count[cell] += 1


def targets(
    boxes: Float32Array,
    classes: Int64Array,
    pixel: float,
) -> Target:
    """The targets of M boxes (M, 7) with classes (M,); pixels have sides of ``pixel`` metres."""
    count = round(2 * REACH / pixel)
    heat = np.zeros((len(CLASSES), count, count), np.float32)
    values = np.zeros((REGRESSED, count, count), np.float32)
    weight = np.zeros((count, count), np.float32)
    for box, each in zip(boxes.astype(np.float64), classes, strict=True):
        centre = (box[:2] + REACH) / pixel
        if (centre < 0).any() or (centre >= count).any():
            continue
        spread = max(0.6, np.sqrt(box[3] * box[4]) / pixel / 6)
        reach = int(np.ceil(3 * spread))
        rows, columns = (
            np.arange(max(c - reach, 0), min(c + reach + 1, count))
            for c in centre.astype(int)
        )
        at = np.ix_(rows, columns)
        square = (rows - int(centre[0]))[:, None] ** 2 + (columns - int(centre[1])) ** 2
        bump = np.exp(-square / (2 * spread**2)).astype(np.float32)
        heat[each][at] = np.maximum(heat[each][at], bump)
        # The pixel of the centre and its neighbours.
        nearest = (bump > weight[at]) & (square <= 2)
        own: list[Any] = [*_offsets(centre, rows, columns), *_shape(box)]
        for channel, value in zip(values, own, strict=True):
            channel[at] = np.where(nearest, value, channel[at])
        weight[at] = np.where(nearest, bump, weight[at])
    return Target(*map(torch.from_numpy, (heat, values, weight)))


def _offsets(
    centre: NDArray[np.float64],
    rows: Int64Array,
    columns: Int64Array,
) -> list[NDArray[np.float64]]:
    """From the middle of each pixel to a centre, in pixels: along the rows and along the
    columns."""
    return list(
        np.broadcast_arrays(
            (centre[0] - rows - 0.5)[:, None], (centre[1] - columns - 0.5)[None]
        )
    )


def _shape(box: NDArray[np.float64]) -> list[float]:
    angle = 2 * box[6]
    return [box[2], *np.log(box[3:6]), np.cos(angle), np.sin(angle)]


def decode(
    heat: Tensor,
    values: Tensor,
    least: float = 0.05,
    most: int = 80,
) -> Found:
    """The boxes of one view.

    Args:
        heat: (classes, n, n) from 0 to 1.
        values: (REGRESSED, n, n).
        least: minimum score.
        most: maximum number of boxes of each class.

    Returns:
        Boxes of each class by falling score, at least ``APART``.
    """
    peaks = heat * (F.max_pool2d(heat[None], 3, 1, 1)[0] == heat)
    boxes = []
    scores = []
    for distance, peak in zip(APART, peaks, strict=True):
        top = peak.flatten().topk(most)
        candidates = boxes_at(top.indices[top.values > least], values)
        kept = _apart(candidates[:, :2], distance)
        boxes.append(candidates[kept])
        scores.append(top.values.numpy()[kept])
    classes = np.repeat(np.arange(len(boxes)), list(map(len, boxes)))
    return Found(np.concatenate(boxes), np.concatenate(scores), classes)


def _apart(
    places: Float32Array,
    distance: float,
) -> list[int]:
    """The places (D, 2) in order, without those within a distance of an earlier one."""
    kept: list[int] = []
    for i, place in enumerate(places):
        if not kept or np.hypot(*(places[kept] - place).T).min() >= distance:
            kept.append(i)
    return kept


def boxes_at(
    index: Tensor,
    values: Tensor,
) -> Float32Array:
    """(D, 7) boxes that the pixels with these flat indices hold."""
    count = values.shape[-1]
    found = values.flatten(1)[:, index].double().numpy()
    pixels = np.stack(np.divmod(index.numpy(), count)) + 0.5
    x, y = (pixels + found[:2]) * 2 * REACH / count - REACH
    sizes = np.exp(found[3:6].clip(-3, 4))
    yaw = np.arctan2(found[7], found[6]) / 2
    return np.stack([x, y, found[2], *sizes, yaw], 1).astype(np.float32)
