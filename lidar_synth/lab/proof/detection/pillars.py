"""What OpenPCDet's detectors on pillars have in common: points by pillar, the convolutions from
above, and the suppression of overlapping boxes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.lab.proof.detection.scores import footprint_ious


class PillarGrid(NamedTuple):
    """Pillars: the corner with the lowest x and y and the middle of the heights in metres, the side
    of a pillar in metres, and the number of pillars along x and along y."""

    low: tuple[float, float]
    middle: float
    side: float
    cells: tuple[int, int]


class Pillars(NamedTuple):
    """Points by pillar.

    Args:
        features: (N, C + 6) of points with C values: these, and x, y, z from the mean of the pillar
            and from its middle.
        pillar: (N,) the pillar of a point, from 0 to P - 1.
        place: (P,) flat index of each pillar, row by row of y.
        number: (P,) number of points.
    """

    features: Tensor
    pillar: Tensor
    place: Tensor
    number: Tensor

    def highest(self, values: Tensor, least: Tensor) -> Tensor:
        """(P, D) the maxima of the values (N, D) of points, at least (P, D)."""
        index = self.pillar[:, None].expand_as(values)
        return least.scatter_reduce(0, index, values, "amax")


def group_points(points: Tensor, grid: PillarGrid, most: int | None = None) -> Pillars:
    """The points (N, C), x, y, z first, that lie in a grid; of each pillar the first ``most``."""
    low = points.new_tensor(grid.low)
    cells = ((points[:, :2] - low) / grid.side).floor()
    inside = ((cells >= 0) & (cells < points.new_tensor(grid.cells))).all(1)
    points = points[inside]
    cells = cells[inside].long()
    flat = cells[:, 1] * grid.cells[0] + cells[:, 0]
    place, pillar = flat.unique(return_inverse=True)  # type: ignore[no-untyped-call]
    if most is not None:
        kept = _rank(pillar) < most
        points = points[kept]
        cells = cells[kept]
        pillar = pillar[kept]
    count = pillar.bincount(minlength=len(place))
    xyz = points[:, :3]
    mean = xyz.new_zeros(len(place), 3).index_add_(0, pillar, xyz) / count[:, None]
    height = xyz.new_full((len(xyz), 1), grid.middle)
    middle = torch.cat([(cells + 0.5) * grid.side + low, height], 1)
    features = torch.cat([points, xyz - mean[pillar], xyz - middle], 1)
    return Pillars(features, pillar, place, count)


def _rank(pillar: Tensor) -> Tensor:
    """(N,) the number of earlier points in the pillar of each point."""
    order = pillar.argsort(stable=True)
    count = pillar.bincount()
    rank = torch.empty_like(pillar)
    rank[order] = torch.arange(len(pillar)) - (count.cumsum(0) - count)[pillar[order]]
    return rank


def spread_pillars(values: Tensor, place: Tensor, grid: PillarGrid) -> Tensor:
    """(1, D, rows of y, columns of x) the values (P, D) of pillars, 0 elsewhere."""
    image = values.new_zeros(values.shape[1], grid.cells[0] * grid.cells[1])
    image[:, place] = values.T
    return image.view(1, -1, grid.cells[1], grid.cells[0])


def make_pillar_layer(inputs: int, outputs: int) -> nn.ModuleDict:
    """A layer for the features of points, with OpenPCDet's names; see ``apply_layer``."""
    return nn.ModuleDict(
        {
            "linear": nn.Linear(inputs, outputs, bias=False),
            "norm": nn.BatchNorm1d(outputs, eps=1e-3),
        }
    )


def apply_layer(layer: nn.ModuleDict, features: Tensor) -> Tensor:
    """(N, outputs) of features (N, inputs)."""
    seen: Tensor = layer["norm"](layer["linear"](features)).relu()
    return seen


def _norm(module: nn.Module, width: int) -> list[nn.Module]:
    return [module, nn.BatchNorm2d(width, eps=1e-3), nn.ReLU(inplace=True)]


def _level(inputs: int, width: int, depth: int) -> nn.Sequential:
    first = nn.Conv2d(inputs, width, 3, 2, bias=False)
    layers = [nn.ZeroPad2d(1), *_norm(first, width)]
    for _ in range(depth):
        layers += _norm(nn.Conv2d(width, width, 3, padding=1, bias=False), width)
    return nn.Sequential(*layers)


class PillarBackbone(nn.Module):
    """Three levels, each at half the resolution of the one before it, brought to one grid.

    Args:
        scales: of each level's grid to the common one; 0.5 halves the resolution.
    """

    def __init__(self, scales: Sequence[float]) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            _level(*sizes) for sizes in ((64, 64, 3), (64, 128, 5), (128, 256, 5))
        )
        self.deblocks = nn.ModuleList(
            nn.Sequential(*_norm(_resize(width, scale), 128))
            for width, scale in zip((64, 128, 256), scales, strict=True)
        )

    def forward(self, image: Tensor) -> Tensor:
        """(1, 384, n, m) of an image (1, 64, h, w)."""
        levels = []
        for block, up in zip(self.blocks, self.deblocks, strict=True):
            image = block(image)
            levels.append(up(image))
        return torch.cat(levels, 1)


def _resize(width: int, scale: float) -> nn.Module:
    if scale < 1:
        step = round(1 / scale)
        return nn.Conv2d(width, 128, step, step, bias=False)
    return nn.ConvTranspose2d(width, 128, int(scale), int(scale), bias=False)


def suppress(
    boxes: NDArray[np.float32],
    scores: NDArray[np.float32],
    common: float,
    before: int,
    after: int,
) -> list[int]:
    """Indices of the boxes (D, 7) that remain, best score (D,) first.

    Args:
        common: maximum intersection over union of the footprints of two boxes.
        before: number of boxes that are looked at, the best ones.
        after: maximum number of boxes that remain.
    """
    left = np.argsort(-scores, kind="stable")[:before]
    kept: list[int] = []
    while len(left) and len(kept) < after:
        best = left[0]
        left = left[1:]
        kept.append(int(best))
        left = left[footprint_ious(boxes[[best]], boxes[left])[0] <= common]
    return kept
