"""PointNet as SpareNet (https://github.com/microsoft/SpareNet) publishes it, trained on ShapeNet;
R2Flow's FPD.

Its 1,808 features are the pooled vector and the three layers after it: 1,024, 512, 256 and 16.
"""

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidar_synth.files.torch_files import load_pickle
from lidar_synth.geometry.scan import Scan
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
    """The layers that every point passes: 3, 64, 128, 1,024 channels (for ``widths`` of the
    published network)."""

    def __init__(self, widths: tuple[int, int, int]) -> None:
        super().__init__()
        for i, (inputs, outputs) in enumerate(
            zip((3, *widths[:2]), widths, strict=True), 1
        ):
            self.add_module(f"conv{i}", nn.Conv1d(inputs, outputs, 1))
            self.add_module(f"bn{i}", nn.BatchNorm1d(outputs))

    def pooled(self, points: Tensor) -> Tensor:
        """(1, 3, N) to (1, widths[2]): the largest value of each feature over all points, before
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

    def __init__(self, widths: tuple[int, int, int], hidden: tuple[int, int]) -> None:
        super().__init__(widths)
        self.fc1 = nn.Linear(widths[2], hidden[0])
        self.fc2 = nn.Linear(*hidden)
        self.fc3 = nn.Linear(hidden[1], 9)
        self.bn4 = nn.BatchNorm1d(hidden[0])
        self.bn5 = nn.BatchNorm1d(hidden[1])

    def forward(self, points: Tensor) -> Tensor:
        """(1, 3, N) to (1, 3, 3)."""
        x = F.relu(self.pooled(points))
        x = F.relu(self.bn5(self.fc2(F.relu(self.bn4(self.fc1(x))))))
        matrix: Tensor = self.fc3(x).view(-1, 3, 3) + torch.eye(3)
        return matrix


class _PointEncoder(_Points):
    def __init__(self, widths: tuple[int, int, int], hidden: tuple[int, int]) -> None:
        super().__init__(widths)
        self.stn = _Transform(widths, hidden)

    def forward(self, points: Tensor) -> Tensor:
        """(1, 3, N) to (1, widths[2])."""
        return self.pooled((points.transpose(2, 1) @ self.stn(points)).transpose(2, 1))


class PointNet(nn.Module):
    """PointNet for classification (Qi et al., CVPR 2017).

    Args:
        widths: channels of the layers that every point passes.
        hidden: channels of the layers after pooling.
        classes: number of classes.
    """

    def __init__(
        self,
        widths: tuple[int, int, int] = (64, 128, 1024),
        hidden: tuple[int, int] = (512, 256),
        classes: int = 16,
    ) -> None:
        super().__init__()
        self.feat = _PointEncoder(widths, hidden)
        self.fc1 = nn.Linear(widths[2], hidden[0])
        self.fc2 = nn.Linear(*hidden)
        self.fc3 = nn.Linear(hidden[1], classes)
        self.bn1 = nn.BatchNorm1d(hidden[0])
        self.bn2 = nn.BatchNorm1d(hidden[1])

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
