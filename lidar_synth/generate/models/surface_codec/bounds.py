"""Constraints of a condition on single cells: where objects may be, their classes, and given
classes."""

from typing import NamedTuple

import torch
from torch import Tensor

from lidar_synth.datasets.classes import IGNORE, LABELS, TRAIN_ID
from lidar_synth.generate.models.surface_codec.blocks import to_patches
from lidar_synth.geometry.layout.layout import CHORD_STEP, CODES, DEPTH_STEP
from lidar_synth.geometry.layout.raster import depths_of
from lidar_synth.geometry.normalize import Normalisation

_LABELS = [LABELS.get(name, -1) for name in CODES]  # by the code of a layout's image


class Bounds(NamedTuple):
    """The part of each ray that is in a box.

    Args:
        near, far: (N, P) normalised ranges where the ray of a cell enters and leaves a box; near >
            far if it meets none.
        label: (N, P) int64 class of the object in the box, -1 = unknown.
        codes: (C,) bool, the classes that are drawn in boxes only: all that move.
    """

    near: Tensor
    far: Tensor
    label: Tensor
    codes: Tensor


def bounds_of(
    layout: Tensor,
    columns: int,
    patch: tuple[int, int],
    codes: int,
    normalisation: Normalisation,
) -> Bounds:
    """The bounds of the cells of N patches.

    Rays that meet no box have near = 1 and far = -1. All rays of a blank image have -1 and 1, since
    nothing is known about them. A column that replaces several has the boxes of all of them, and
    the class of the nearest box.

    Args:
        layout: (B, 5, H, W) uint8, images of layouts.
        columns: of the cells; a divisor of W.
        patch: rows and columns of a patch.
        codes: number of classes.
        normalisation: of the ranges.
    """
    code = layout[:, 0]
    # Images round to the nearest step: at worst, a ray enters and leaves half a step further in.
    depth = depths_of(layout) + DEPTH_STEP / 2
    chord = (layout[:, 3].float() - 0.5) * CHORD_STEP - DEPTH_STEP
    boxed = code >= CODES["Car"]
    blank = (code == 0).all(2).all(1)[:, None, None]
    near = torch.where(boxed, normalisation.encode(depth), 1.0).masked_fill(blank, -1.0)
    far = torch.where(
        boxed, normalisation.encode(depth + chord.clamp(min=0)), -1.0
    ).masked_fill(blank, 1.0)
    labels = torch.tensor(_LABELS, device=layout.device)[code.long()]
    shape = (*near.shape[:2], columns, -1)
    near, nearest = near.reshape(shape).min(3)
    labels = labels.reshape(shape).gather(3, nearest[..., None])[..., 0]
    parts = torch.stack([near, far.reshape(shape).amax(3), labels.float()], 1)
    # Parked bicycles and motorcycles, too: layouts do not contain them, and elsewhere than in a box
    # they would be drawn as streaks.
    kinds = torch.arange(codes, device=layout.device) <= TRAIN_ID["motorcyclist"]
    near, far, labels = to_patches(parts, patch).unbind(1)
    return Bounds(near, far, labels.long(), kinds)


def codes_of(labels: Tensor, columns: int, patch: tuple[int, int]) -> Tensor:
    """(N, P) int64 classes of the cells of N patches, -1 where they are not known.

    A column that replaces several has the first class of them that is known.

    Args:
        labels: (B, H, W) uint8 train ids, 255 = unknown.
        columns: of the cells; a divisor of W.
        patch: rows and columns of a patch.
    """
    parts = (
        torch.where(labels == IGNORE, -1, labels.long())
        .view(*labels.shape[:2], columns, -1)
        .unbind(3)
    )
    codes = parts[0]
    for part in parts[1:]:
        codes = torch.where(codes < 0, part, codes)
    return to_patches(codes[:, None], patch)[:, 0]
