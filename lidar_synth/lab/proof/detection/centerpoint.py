"""CenterPoint on pillars (Yin et al. 2021) as OpenPCDet releases it for nuScenes
(``cbgs_dyn_pp_centerpoint``): from a scan's points to boxes all around.

The weights are trained on ten sweeps at once, of a sensor with 32 lasers 1.84 m above the road, in
nuScenes' frame: x right, y forward. A single scan holds a tenth of those returns, so that its
figures say something only beside those of real scans.
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

REACH = 51.2
"""Metres from the sensor to each side of the grid."""
GRID = PillarGrid((-REACH, -REACH), -1.0, 0.2, (512, 512))
STRIDE = 4
"""Side of a pixel of the output, pillars."""
TASKS = (1, 2, 2, 1, 2, 2)
"""Number of classes of each head: car; truck, construction vehicle; bus, trailer; barrier;
motorcycle, bicycle; pedestrian, traffic cone."""
JUDGED = ((0, 0), (5, 0), (4, 1))
"""Head and class in it of cars, pedestrians and cyclists, whose boxes nuScenes calls bicycles."""
VALUES = {"center": 2, "center_z": 1, "dim": 3, "rot": 2, "vel": 2}
CANDIDATES = 500
"""Number of pixels of each head that may be centres."""
LEAST_SCORE = 0.1
SUPPRESSION = (0.2, 1000, 83)
BRIGHTEST = 255.0
"""The reflectance in nuScenes' files that the package calls 1."""


def _branch(outputs: int) -> nn.Sequential:
    first = [nn.Conv2d(64, 64, 3, padding=1), nn.BatchNorm2d(64), nn.ReLU(inplace=True)]
    return nn.Sequential(nn.Sequential(*first), nn.Conv2d(64, outputs, 3, padding=1))


class CenterPoint(nn.Module):
    """The network, with OpenPCDet's names of its weights."""

    def __init__(self) -> None:
        super().__init__()
        # Plain lists register nothing: the names of the weights are those of ``vfe``.
        self.layers = [make_pillar_layer(11, 32), make_pillar_layer(64, 64)]
        self.vfe = nn.ModuleDict({"pfn_layers": nn.ModuleList(self.layers)})
        self.backbone_2d = PillarBackbone((0.5, 1, 2))
        shared = [nn.Conv2d(384, 64, 3, padding=1), nn.BatchNorm2d(64), nn.ReLU()]
        heads = nn.ModuleList(
            nn.ModuleDict(
                {name: _branch(n) for name, n in (VALUES | {"hm": count}).items()}
            )
            for count in TASKS
        )
        self.dense_head = nn.ModuleDict(
            {"shared_conv": nn.Sequential(*shared), "heads_list": heads}
        )

    def forward(self, points: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Boxes (D, 7), scores (D,) and classes (D,) within the head, of the ``CANDIDATES`` best
        pixels of each head, by falling score, before any are suppressed; for points (N, 5) x, y, z
        in metres, intensity from 0 to 255 and time in seconds. All in nuScenes' frame."""
        pillars = group_points(points, GRID)
        first, second = self.layers
        seen = apply_layer(first, pillars.features)
        zeros = seen.new_zeros(len(pillars.place), 64)
        best = pillars.highest(seen, zeros[:, :32])
        seen = apply_layer(second, torch.cat([seen, best[pillars.pillar]], 1))
        image = spread_pillars(pillars.highest(seen, zeros), pillars.place, GRID)
        x = self.dense_head["shared_conv"](self.backbone_2d(image))
        return [
            decode_centres({name: make(x)[0] for name, make in head.named_children()})
            for head in self.dense_head["heads_list"].children()
        ]

    def sees(self, places: NDArray[np.floating]) -> NDArray[np.bool_]:
        """(N,) which places (N, 2 or more), metres in the sensor frame, lie within the limits."""
        return np.asarray((np.abs(places[:, :2]) < REACH).all(1))

    def find(self, scan: Scan) -> Found:
        """The cars, pedestrians and cyclists around the sensor, in evaluation mode."""
        x, y, z = scan.points.T
        columns = [-y, x, z, scan.reflectance * BRIGHTEST, np.zeros(len(scan))]
        points = np.column_stack(columns).astype(np.float32)
        with torch.inference_mode():
            heads = self(torch.from_numpy(points))
        found = []
        for task, (boxes, scores, classes) in enumerate(heads):
            likely = (scores > LEAST_SCORE) & boxes.isfinite().all(1)
            own = Found(*(part[likely].numpy() for part in (boxes, scores, classes)))
            kept = suppress(own.boxes, own.scores, *SUPPRESSION)
            for number, judged in enumerate(JUDGED):
                mine = [i for i in kept if (task, own.classes[i]) == judged]
                mine_class = np.full(len(mine), number)
                found.append(Found(own.boxes[mine], own.scores[mine], mine_class))
        boxes = np.concatenate([one.boxes for one in found])
        boxes[:, 0], boxes[:, 1] = boxes[:, 1].copy(), -boxes[:, 0]
        boxes[:, 6] -= np.pi / 2
        seen = self.sees(boxes)
        scores, classes = (
            np.concatenate([getattr(one, name) for one in found])[seen]
            for name in ("scores", "classes")
        )
        return Found(boxes[seen], scores, classes)


def decode_centres(maps: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes (D, 7), scores (D,) and classes (D,) of the best pixels of one head's maps (n, 128,
    128)."""
    heat = maps["hm"].sigmoid()
    scores, flat = heat.flatten().topk(CANDIDATES)
    size = heat.shape[2]
    classes = flat // size**2
    pixel = flat % size**2
    at = {name: maps[name].flatten(1)[:, pixel] for name in VALUES}
    places = torch.stack([pixel % size, pixel // size]) + at["center"]
    places = places * STRIDE * GRID.side - REACH
    yaw = torch.atan2(at["rot"][1], at["rot"][0])
    boxes = torch.cat([places, at["center_z"], at["dim"].exp(), yaw[None]]).T
    return boxes, scores, classes
