"""PointPillars (Lang et al. 2019) as OpenPCDet releases it for KITTI, such as
``pointpillar_7728.pth``: from a scan's points to boxes.

The weights are trained on what the left colour camera of KITTI sees: 81 degrees in front of the
sensor, which stands 1.73 m above the road.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.geometry import Scan
from lidar_synth.lab.proof.detection.bev import Found
from lidar_synth.lab.proof.detection.pillars import (
    PillarBackbone,
    PillarGrid,
    apply_layer,
    group_points,
    make_pillar_layer,
    spread_pillars,
    suppress,
)

GRID = PillarGrid((0.0, -39.68), -1.0, 0.16, (432, 496))
HIGH = (69.12, 39.68)
"""The limits of x and y, metres."""
HEIGHTS = (-3.0, 1.0)
"""The limits of z, metres."""
MOST_POINTS = 32
"""Maximum number of points of a pillar."""
HALF_VIEW = np.deg2rad(40.5)
"""From the x axis to the sides of the camera's view."""
ANCHORS = ((3.9, 1.6, 1.56, -1.78), (0.8, 0.6, 1.73, -0.6), (1.76, 0.6, 1.73, -0.6))
"""Length, width, height and floor of the anchors of cars, pedestrians and cyclists, metres."""
TURNS = (0.0, 1.57)
"""Yaw of the two anchors of each class."""
FRONT = 0.78539
"""Yaw from which the half turn begins that the classifier of directions calls 0."""
LEAST_SCORE = 0.1
SUPPRESSION = (0.01, 4096, 500)


class PointPillars(nn.Module):
    """The network, with OpenPCDet's names of its weights."""

    def __init__(self) -> None:
        super().__init__()
        # Plain lists register nothing: the names of the weights are those of ``vfe``.
        self.layers = [make_pillar_layer(10, 64)]
        self.vfe = nn.ModuleDict({"pfn_layers": nn.ModuleList(self.layers)})
        self.backbone_2d = PillarBackbone((1, 2, 4))
        count = len(ANCHORS) * len(TURNS)
        heads = {"conv_cls": 3, "conv_box": 7, "conv_dir_cls": 2}
        self.dense_head = nn.ModuleDict(
            {name: nn.Conv2d(384, count * each, 1) for name, each in heads.items()}
        )
        self.register_buffer("anchors", _anchors(), persistent=False)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (A, 3) of the classes, and boxes (A, 7) as ``Boxes.values``, of all anchors, for
        points (N, 4) x, y, z in metres and reflectance in [0, 1]."""
        joined = self.backbone_2d(self._image(points))
        anchors = self.get_buffer("anchors")
        logits, values, turns = (
            head(joined)[0].permute(1, 2, 0).reshape(len(anchors), -1)
            for head in self.dense_head.values()
        )
        return logits, decode_anchors(values, turns.argmax(1), anchors)

    def _image(self, points: Tensor) -> Tensor:
        low, high = HEIGHTS
        points = points[(points[:, 2] >= low) & (points[:, 2] < high)]
        pillars = group_points(points, GRID, MOST_POINTS)
        [layer] = self.layers
        seen = apply_layer(layer, pillars.features)
        # A pillar that is not full also holds empty points, which the layer sees as zeros.
        empty = layer["norm"](seen.new_zeros(1, seen.shape[1])).relu()
        least = torch.where((pillars.number < MOST_POINTS)[:, None], empty, 0.0)
        return spread_pillars(pillars.highest(seen, least), pillars.place, GRID)

    def sees(self, places: NDArray[np.floating]) -> NDArray[np.bool_]:
        """(N,) which places (N, 2 or more), metres in the sensor frame, lie within the limits of x
        and y and in the camera's view."""
        x, y = places[:, :2].T
        inside = (np.abs(y) < HIGH[1]) & (x < HIGH[0])
        return np.asarray(inside & (np.abs(np.arctan2(y, x)) <= HALF_VIEW))

    def find(self, scan: Scan) -> Found:
        """The cars, pedestrians and cyclists in front of the sensor, in evaluation mode."""
        seen = self.sees(scan.points)
        points = np.column_stack([scan.points[seen], scan.reflectance[seen]])
        with torch.inference_mode():
            logits, boxes = self(torch.from_numpy(points.astype(np.float32)))
            scores, classes = logits.sigmoid().max(1)
            likely = (scores >= LEAST_SCORE) & boxes.isfinite().all(1)
        found = Found(*(part[likely].numpy() for part in (boxes, scores, classes)))
        kept = np.array(suppress(found.boxes, found.scores, *SUPPRESSION), np.int64)
        kept = kept[self.sees(found.boxes[kept])]
        return Found(found.boxes[kept], found.scores[kept], found.classes[kept])


def _anchors() -> Tensor:
    """(A, 7) boxes: rows of y, in them x, in them classes, in them turns."""
    x, y = (
        torch.linspace(low, high, count // 2, dtype=torch.float64)
        for low, high, count in zip(GRID.low, HIGH, GRID.cells, strict=True)
    )
    each = torch.tensor(
        [
            (floor + height / 2, length, width, height, turn)
            for length, width, height, floor in ANCHORS
            for turn in TURNS
        ],
        dtype=torch.float64,
    )
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    places = torch.stack([columns, rows], -1).view(-1, 1, 2)
    count = len(each)
    parts = [places.expand(-1, count, -1), each.expand(len(places), -1, -1)]
    return torch.cat(parts, -1).view(-1, 7).float()


def decode_anchors(values: Tensor, turns: Tensor, anchors: Tensor) -> Tensor:
    """(A, 7) the boxes that values (A, 7) make of anchors (A, 7); turns (A,) are 1 for a box that
    points into the other half turn."""
    diagonal = anchors[:, 3:5].norm(dim=1, keepdim=True)
    scale = torch.cat([diagonal, diagonal, anchors[:, 5:6]], 1)
    centre = values[:, :3] * scale + anchors[:, :3]
    size = values[:, 3:6].exp() * anchors[:, 3:6]
    turned = values[:, 6] + anchors[:, 6] - FRONT
    yaw = turned % torch.pi + FRONT + torch.pi * turns
    return torch.cat([centre, size, yaw[:, None]], 1)
