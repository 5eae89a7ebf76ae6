"""A second network for ``prove``: points in polar pillars, a small U-Net over the bird's-eye view
of them, and a perceptron of each point and its pillar (after PolarNet). No range image.

``learn`` is a trainer of ``prove``; few_labels.py --polar runs it.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.datasets.classes import NAMES
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.segmentation import tabulate
from lidar_synth.lab.evaluate.segmenter import CircularConv
from lidar_synth.lab.proof import Job
from lidar_synth.lab.train.segmentation import balanced_cross_entropy

RINGS = 64
SECTORS = 128
NEAR = 2.0
FAR = 60.0
"""Metres; the rings' widths grow with the distance."""
WIDTH = 32
RATE = 4e-3


class PolarNetwork(nn.Module):
    """Predicts the class of every point of some scans."""

    def __init__(self) -> None:
        super().__init__()
        self.point = nn.Sequential(
            nn.Linear(7, WIDTH),
            nn.BatchNorm1d(WIDTH),
            nn.ReLU(),
            nn.Linear(WIDTH, WIDTH),
        )
        self.first = CircularConv(WIDTH, WIDTH)
        self.second = CircularConv(WIDTH, 2 * WIDTH, (2, 2))
        self.third = CircularConv(2 * WIDTH, 2 * WIDTH, (2, 2))
        self.middle = CircularConv(2 * WIDTH, 2 * WIDTH)
        self.up = CircularConv(4 * WIDTH, WIDTH)
        self.out = CircularConv(2 * WIDTH, WIDTH)
        self.last = nn.Sequential(
            nn.Linear(2 * WIDTH, 64),
            nn.BatchNorm1d(64),
            nn.ReLU(),
            nn.Linear(64, len(NAMES)),
        )

    def forward(self, scans: Sequence[Scan]) -> Tensor:
        """Scans of N points in all to (N, classes) logits."""
        seen, cell = place_points(scans)
        x = self.point(seen)
        size = len(scans) * RINGS * SECTORS
        pillars = x.new_zeros(size, WIDTH)
        pillars = pillars.scatter_reduce(0, cell[:, None].expand(-1, WIDTH), x, "amax")
        image = pillars.reshape(len(scans), RINGS, SECTORS, WIDTH).permute(0, 3, 1, 2)
        out = self._look_around(image)
        around = out.permute(0, 2, 3, 1).reshape(size, WIDTH)[cell]
        logits: Tensor = self.last(torch.cat([F.relu(x), around], 1))
        return logits

    def _look_around(self, image: Tensor) -> Tensor:
        """(B, WIDTH, RINGS, SECTORS) features of pillars to those of their surroundings."""
        a = self.first(image)
        b = self.second(a)
        c = self.middle(self.third(b))
        up = self.up(torch.cat([F.interpolate(c, scale_factor=2), b], 1))
        out: Tensor = self.out(torch.cat([F.interpolate(up, scale_factor=2), a], 1))
        return out


def place_points(scans: Sequence[Scan]) -> tuple[Tensor, Tensor]:
    """(N, 7) inputs of all points, and (N,) numbers of their pillars."""
    points = torch.from_numpy(np.concatenate([s.points for s in scans]))
    reflectance = torch.from_numpy(np.concatenate([s.reflectance for s in scans]))
    counts = torch.tensor([len(s) for s in scans])
    scan = torch.repeat_interleave(torch.arange(len(scans)), counts)
    flat = points[:, :2].norm(dim=1)
    ring = (flat.clamp(NEAR, FAR) / NEAR).log() / np.log(FAR / NEAR) * (RINGS - 1)
    angle = torch.atan2(points[:, 1], points[:, 0])
    sector = (angle / (2 * np.pi) + 0.5) * SECTORS
    row = ring.round()
    column = sector.floor()
    inputs = [
        points[:, 2] / 2,
        flat / 20,
        points[:, 2] / flat.clamp(min=1) * 5,
        reflectance * 2,
        ring - row,
        sector - column - 0.5,
        torch.ones_like(flat),
    ]
    cell = (scan * RINGS + row.long()) * SECTORS + column.long() % SECTORS
    return torch.stack(inputs, 1), cell


def learn(job: Job) -> dict[str, NDArray[np.int64]]:
    """Train as a job says; {place: (19, 19) confusion table}."""
    torch.manual_seed(job.seed)
    network = PolarNetwork()
    batches = (
        [mixed[number] for number in range(start, start + job.batch)]
        for mixed, count in job.mixtures(to_sample=lambda scan, rng: scan)
        for start in range(0, count * job.batch, job.batch)
    )
    train(network, batches, job.iterations)
    network.eval()
    return {place: table_of(network, scans) for place, scans in job.held_out.items()}


def train(network: nn.Module, batches: Iterable[list[Scan]], count: int) -> None:
    """One cycle of the learning rate over a number of batches; the loss of ``reference``."""
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=0.01)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, count)
    for scans in batches:
        label = torch.from_numpy(np.concatenate([s.label for s in scans])).long()
        loss = balanced_cross_entropy(network(scans), label)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        cycle.step()


@torch.no_grad()
def table_of(network: nn.Module, scans: Sequence[Scan]) -> NDArray[np.int64]:
    """(19, 19) number of returns by label (row) and prediction (column)."""
    label = np.concatenate([scan.label for scan in scans if scan.label is not None])
    guess = torch.cat([network([scan]).argmax(1) for scan in scans]).numpy()
    return tabulate(label, guess)
