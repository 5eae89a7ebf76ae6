"""PointNet as SpareNet (https://github.com/microsoft/SpareNet) publishes it, trained on ShapeNet;
R2Flow's FPD.

Its 1,808 features are the pooled vector and the three layers after it: 1,024, 512, 256 and 16.
"""

from itertools import pairwise
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.files.torch_files import load_pickle
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.extractors.archive import load_weights
from lidar_synth.lab.evaluate.extractors.inputs import preparation
from lidar_synth.lab.evaluate.extractors.per_scan import PerScan, some

METRES = 80.0
"""R2Flow divides coordinates by it."""

CELLS = 64 * 1024
"""Cells of R2Flow's range image; an empty one is a point at the origin."""

BLOCK = 8192
"""Points that pass the network at a time."""


class _Points(nn.Module):
    """The layers that every point passes."""

    def __init__(self) -> None:
        super().__init__()
        for i, (inputs, outputs) in enumerate(pairwise((3, 64, 128, 1024)), 1):
            self.add_module(f"conv{i}", nn.Conv1d(inputs, outputs, 1))
            self.add_module(f"bn{i}", nn.BatchNorm1d(outputs))

    def pooled(self, points: Tensor) -> Tensor:
        """(1, 3, N) to (1, 1024): the largest value of each feature over all points, before
        the last ReLU."""
        best = [self._features(part).amax(2) for part in torch.split(points, BLOCK, 2)]
        return torch.stack(best).amax(0)

    def _features(self, x: Tensor) -> Tensor:
        for i in (1, 2):
            x = F.relu(self.get_submodule(f"bn{i}")(self.get_submodule(f"conv{i}")(x)))
        features: Tensor = self.get_submodule("bn3")(self.get_submodule("conv3")(x))
        return features


class _Transform(_Points):
    """Predicts a 3 x 3 matrix for the cloud."""

    def __init__(self) -> None:
        super().__init__()
        self.fc1 = nn.Linear(1024, 512)
        self.fc2 = nn.Linear(512, 256)
        self.fc3 = nn.Linear(256, 9)
        self.bn4 = nn.BatchNorm1d(512)
        self.bn5 = nn.BatchNorm1d(256)

    def forward(self, points: Tensor) -> Tensor:
        """(1, 3, N) to (1, 3, 3)."""
        x = F.relu(self.pooled(points))
        x = F.relu(self.bn5(self.fc2(F.relu(self.bn4(self.fc1(x))))))
        matrix: Tensor = self.fc3(x).view(-1, 3, 3) + torch.eye(3)
        return matrix


class _PointEncoder(_Points):
    def __init__(self) -> None:
        super().__init__()
        self.stn = _Transform()

    def forward(self, points: Tensor) -> Tensor:
        """(1, 3, N) to (1, 1024)."""
        return self.pooled((points.transpose(2, 1) @ self.stn(points)).transpose(2, 1))


class PointNet(nn.Module):
    """PointNet for classification (Qi et al., CVPR 2017)."""

    def __init__(self) -> None:
        super().__init__()
        self.feat = _PointEncoder()
        self.fc1 = nn.Linear(1024, 512)
        self.fc2 = nn.Linear(512, 256)
        self.fc3 = nn.Linear(256, 16)
        self.bn1 = nn.BatchNorm1d(512)
        self.bn2 = nn.BatchNorm1d(256)

    def forward(self, points: Tensor) -> Tensor:
        """(1, 3, N) to (1, D): the pooled features and those of the three layers after them."""
        pooled = self.feat(points)
        first = F.relu(self.bn1(self.fc1(pooled)))
        second = F.relu(self.bn2(self.fc2(first)))
        return torch.cat([pooled, first, second, self.fc3(second)], 1)


def load_pointnet(path: Path, prepared: str) -> PerScan:
    """The published network as an extractor; see ``load_extractor``."""
    network = PointNet()
    load_weights(network, load_pickle(path, "SpareNet"), str(path))
    network.eval()
    inputs = preparation(prepared)

    def describe(scan: Scan, generated: bool) -> Tensor:
        cloud = torch.from_numpy(inputs.cloud(scan, generated)) / METRES
        # features are maxima, so that one point at the origin stands for all empty cells
        if some(cloud) < CELLS:
            cloud = torch.cat([cloud, torch.zeros(1, 3)])
        return network(cloud.T[None])[0]  # type: ignore[no-any-return]

    return PerScan(describe)
