"""PointPillars (Lang et al. 2019) as OpenPCDet releases it for KITTI, such as
``pointpillar_7728.pth``: from a scan's points to boxes.

The weights are trained on what the left colour camera of KITTI sees: 81 degrees in front of the
sensor, which stands 1.73 m above the road.
"""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.errors import DataError
from lidar_synth.files.torch_files import load_pickle
from lidar_synth.geometry.scan import Scan
from lidar_synth.lab.evaluate.extractors.archive import load_weights
from lidar_synth.lab.proof.detection.bev import Found
from lidar_synth.lab.proof.detection.scores import footprint_ious

LOW = (0.0, -39.68, -3.0)
HIGH = (69.12, 39.68, 1.0)
"""The limits of what it sees, metres in the sensor frame."""
PILLAR = 0.16
"""Side of a pillar, metres."""
GRID = (432, 496)
"""Pillars along x and along y."""
MOST_POINTS = 32
"""Maximum number of points of a pillar: its first ones count."""
HALF_VIEW = np.deg2rad(40.5)
"""From the x axis to the sides of the camera's view."""
ANCHORS = ((3.9, 1.6, 1.56, -1.78), (0.8, 0.6, 1.73, -0.6), (1.76, 0.6, 1.73, -0.6))
"""Length, width, height and floor of the anchors of cars, pedestrians and cyclists, metres."""
TURNS = (0.0, 1.57)
"""Yaw of the two anchors of each class."""
FRONT = 0.78539
"""Yaw from which the half turn begins that the classifier of directions calls 0."""
LEAST_SCORE = 0.1
MOST_BOXES = (4096, 500)
"""Maximum number before and after the suppression of overlapping boxes."""
COMMON = 0.01
"""Maximum intersection over union of two boxes, of any classes."""


def in_view(places: NDArray[np.floating]) -> NDArray[np.bool_]:
    """(N,) which places (N, 2 or more), metres in the sensor frame, lie within the limits of x and
    y and in the camera's view."""
    x, y = places[:, :2].T
    inside = (np.abs(y) < HIGH[1]) & (x < HIGH[0])
    return np.asarray(inside & (np.abs(np.arctan2(y, x)) <= HALF_VIEW))


def _norm(module: nn.Module, width: int) -> list[nn.Module]:
    return [module, nn.BatchNorm2d(width, eps=1e-3), nn.ReLU(inplace=True)]


class PointPillars(nn.Module):
    """The network, with OpenPCDet's names of its weights."""

    def __init__(self) -> None:
        super().__init__()
        pillar = nn.ModuleDict(
            {
                "linear": nn.Linear(10, 64, bias=False),
                "norm": nn.BatchNorm1d(64, eps=1e-3),
            }
        )
        self.vfe = nn.ModuleDict({"pfn_layers": nn.ModuleList([pillar])})
        self.backbone_2d = nn.ModuleDict(
            {
                "blocks": nn.ModuleList(
                    _level(*sizes)
                    for sizes in ((64, 64, 3), (64, 128, 5), (128, 256, 5))
                ),
                "deblocks": nn.ModuleList(
                    nn.Sequential(
                        *_norm(nn.ConvTranspose2d(width, 128, n, n, bias=False), 128)
                    )
                    for width, n in ((64, 1), (128, 2), (256, 4))
                ),
            }
        )
        count = len(ANCHORS) * len(TURNS)
        self.dense_head = nn.ModuleDict(
            {
                name: nn.Conv2d(384, count * each, 1)
                for name, each in (
                    ("conv_cls", 3),
                    ("conv_box", 7),
                    ("conv_dir_cls", 2),
                )
            }
        )
        self.register_buffer("anchors", _anchors(), persistent=False)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (A, 3) of the classes, and boxes (A, 7) as ``Boxes.values``, of all anchors, for
        points (N, 4) x, y, z in metres and reflectance in [0, 1]."""
        x = self._image(points)
        levels = []
        for block, up in zip(
            self.backbone_2d["blocks"].children(),
            self.backbone_2d["deblocks"].children(),
            strict=True,
        ):
            x = block(x)
            levels.append(up(x))
        joined = torch.cat(levels, 1)
        logits, values, turns = (
            self.dense_head[name](joined)[0]
            .permute(1, 2, 0)
            .reshape(len(self.anchors), -1)  # type: ignore[arg-type]
            for name in ("conv_cls", "conv_box", "conv_dir_cls")
        )
        return logits, decode_anchors(values, turns.argmax(1), self.anchors)  # type: ignore[arg-type]

    def _image(self, points: Tensor) -> Tensor:
        """(1, 64, 496, 432): the features of pillars from above, 0 where there is no point."""
        low = points.new_tensor(LOW)
        cells = (
            (points[:, :3] - low) / points.new_tensor((PILLAR, PILLAR, 4.0))
        ).floor()
        limits = points.new_tensor((*GRID, 1))
        inside = ((cells >= 0) & (cells < limits)).all(1)
        points = points[inside]
        cells = cells[inside, :2].long()
        place, pillar = (cells[:, 1] * GRID[0] + cells[:, 0]).unique(  # type: ignore[no-untyped-call]
            return_inverse=True
        )
        kept = _first(pillar, MOST_POINTS)
        points, cells, pillar = points[kept], cells[kept], pillar[kept]
        count = pillar.bincount(minlength=len(place))
        sums = points.new_zeros(len(place), 3).index_add_(0, pillar, points[:, :3])
        middle = torch.cat(
            [(cells + 0.5) * PILLAR + low[:2], points.new_full((len(points), 1), -1.0)],
            1,
        )
        xyz = points[:, :3]
        features = torch.cat(
            [points, xyz - (sums / count[:, None])[pillar], xyz - middle], 1
        )
        layer = self.vfe["pfn_layers"][0]  # type: ignore[index]
        seen = layer["norm"](layer["linear"](features)).relu()
        # A pillar that is not full also holds empty points, which the layer sees as zeros.
        empty = layer["norm"](features.new_zeros(1, seen.shape[1])).relu()
        start = torch.where((count < MOST_POINTS)[:, None], empty, 0.0)
        best = start.scatter_reduce(0, pillar[:, None].expand_as(seen), seen, "amax")
        image = best.new_zeros(seen.shape[1], GRID[0] * GRID[1])
        image[:, place] = best.T
        return image.view(1, -1, GRID[1], GRID[0])


def _level(inputs: int, width: int, depth: int) -> nn.Sequential:
    first = nn.Conv2d(inputs, width, 3, 2, bias=False)
    layers = [nn.ZeroPad2d(1), *_norm(first, width)]
    for _ in range(depth):
        layers += _norm(nn.Conv2d(width, width, 3, padding=1, bias=False), width)
    return nn.Sequential(*layers)


def _first(pillar: Tensor, most: int) -> Tensor:
    """(N,) whether a point is among the first ones of its pillar (N,)."""
    order = pillar.argsort(stable=True)
    count = pillar.bincount()
    rank = torch.empty_like(pillar)
    rank[order] = torch.arange(len(pillar)) - (count.cumsum(0) - count)[pillar[order]]
    return rank < most


def _anchors() -> Tensor:
    """(A, 7) boxes: rows of y, in them x, in them classes, in them turns."""
    x, y = (
        torch.linspace(low, high, count // 2, dtype=torch.float64)
        for low, high, count in zip(LOW, HIGH, GRID, strict=False)
    )
    each = torch.tensor(
        [
            (floor + height / 2, length, width, height, turn)
            for length, width, height, floor in ANCHORS
            for turn in TURNS
        ],
        dtype=torch.float64,
    )
    places = (
        torch.stack(torch.meshgrid(y, x, indexing="ij"), -1).flip(-1).view(-1, 1, 2)
    )
    count = len(each)
    grid = [places.expand(-1, count, -1), each.expand(len(places), -1, -1)]
    return torch.cat(grid, -1).view(-1, 7).float()


def decode_anchors(values: Tensor, turns: Tensor, anchors: Tensor) -> Tensor:
    """(A, 7) the boxes that values (A, 7) make of anchors (A, 7); turns (A,) are 1 for a box that
    points into the other half turn."""
    diagonal = anchors[:, 3:5].norm(dim=1, keepdim=True)
    scale = torch.cat([diagonal, diagonal, anchors[:, 5:6]], 1)
    centre = values[:, :3] * scale + anchors[:, :3]
    size = values[:, 3:6].exp() * anchors[:, 3:6]
    yaw = (values[:, 6] + anchors[:, 6] - FRONT) % torch.pi + FRONT + torch.pi * turns
    return torch.cat([centre, size, yaw[:, None]], 1)


def suppress(boxes: NDArray[np.float32], scores: NDArray[np.float32]) -> list[int]:
    """Indices of the boxes (D, 7) that remain, best score (D,) first: no two have footprints with
    more than ``COMMON`` intersection over union."""
    before, after = MOST_BOXES
    left = np.argsort(-scores, kind="stable")[:before]
    kept: list[int] = []
    while len(left) and len(kept) < after:
        best, left = left[0], left[1:]
        kept.append(int(best))
        left = left[footprint_ious(boxes[[best]], boxes[left])[0] <= COMMON]
    return kept


def find_boxes(network: PointPillars, scan: Scan) -> Found:
    """The cars, pedestrians and cyclists in front of the sensor that a network in evaluation mode
    finds in a scan."""
    seen = in_view(scan.points)
    points = np.column_stack([scan.points[seen], scan.reflectance[seen]])
    with torch.inference_mode():
        logits, boxes = network(torch.from_numpy(points.astype(np.float32)))
        scores, classes = logits.sigmoid().max(1)
        likely = (scores >= LEAST_SCORE) & boxes.isfinite().all(1)
    found = boxes[likely].numpy()
    kept = suppress(found, scores[likely].numpy())
    kept = [i for i, there in zip(kept, in_view(found[kept]), strict=True) if there]
    return Found(
        found[kept], scores[likely].numpy()[kept], classes[likely].numpy()[kept]
    )


def load_detector(path: Path) -> PointPillars:
    """Load a checkpoint of OpenPCDet's PointPillars for KITTI, without running code of the file.

    Raises:
        FileError: if the file cannot be read.
        DataError: on a damaged file, or weights of another network.
    """
    content = load_pickle(Path(path), "OpenPCDet")
    if not isinstance(content, dict) or "model_state" not in content:
        raise DataError(
            f"{path} without model_state",
            "a checkpoint of OpenPCDet, such as pointpillar_7728.pth",
        )
    network = PointPillars()
    load_weights(network, content["model_state"], str(path), extra=True)
    return network.eval()
