"""A second network for ``prove``: a multilayer perceptron of points that sees the largest features
of the points around each one, in cubes of several sizes. No range image, no convolution.

``learn`` is a trainer of ``prove``; fewer_beams.py runs it.
"""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.geometry.scan import Scan
from lidar_synth.lab.proof import Job

CUBES = (0.4, 1.2, 4.0)
"""Sides in metres."""
RATE = 5e-3
WIDTH = 48


class PointNetwork(nn.Module):
    """Predicts the class of every point of some scans."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Linear(4, WIDTH)
        self.levels = nn.ModuleList(
            nn.Sequential(nn.Linear(2 * WIDTH + 3, WIDTH), nn.LayerNorm(WIDTH))
            for _ in CUBES
        )
        self.last = nn.Linear(WIDTH * (1 + len(CUBES)), len(NAMES))

    def forward(self, scans: Sequence[Scan]) -> Tensor:
        """Scans of N points in all to (N, classes) logits."""
        points = torch.from_numpy(np.concatenate([s.points for s in scans]))
        reflectance = torch.from_numpy(np.concatenate([s.reflectance for s in scans]))
        counts = torch.tensor([len(s) for s in scans])
        scan = torch.repeat_interleave(torch.arange(len(scans)), counts)
        flat = points[:, :2].norm(dim=1)
        seen = [points[:, 2] / 2, flat / 20, points[:, 2] / flat * 5, reflectance * 2]
        x = F.relu(self.first(torch.stack(seen, 1)))
        found = [x]
        for side, level in zip(CUBES, self.levels, strict=True):
            place = torch.floor(points / side).long() + 512
            key = ((scan * 1024 + place[:, 0]) * 1024 + place[:, 1]) * 1024
            cubes, cube = torch.unique(key + place[:, 2], return_inverse=True)
            rows = cube[:, None].expand(-1, WIDTH)
            largest = x.new_zeros(len(cubes), WIDTH).scatter_reduce(0, rows, x, "amax")
            inside = points / side - torch.floor(points / side) - 0.5
            x = F.relu(level(torch.cat([x, largest[cube], inside], 1)))
            found.append(x)
        logits: Tensor = self.last(torch.cat(found, 1))
        return logits


def learn(job: Job) -> dict[str, NDArray[np.int64]]:
    """Train as a job says; {place: (19, 19) confusion table}."""
    torch.manual_seed(job.seed)
    network = PointNetwork()
    mixtures = job.mixtures(to_sample=lambda scan, rng: scan)
    for (mixed, count), (stage, _) in zip(mixtures, job.stages(), strict=True):
        rate = RATE * stage.rate
        optimiser = torch.optim.AdamW(network.parameters(), rate)
        cycle = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, count)
        for step in range(count):
            scans = [mixed[step * job.batch + i] for i in range(job.batch)]
            label = torch.from_numpy(np.concatenate([s.label for s in scans])).long()
            loss = F.cross_entropy(network(scans), label, ignore_index=IGNORE)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            cycle.step()
    return {place: table_of(network, scans) for place, scans in job.held_out.items()}


@torch.no_grad()
def table_of(network: PointNetwork, scans: Sequence[Scan]) -> NDArray[np.int64]:
    """(19, 19) number of returns by label (row) and prediction (column)."""
    label = np.concatenate([scan.label for scan in scans if scan.label is not None])
    guess = torch.cat([network([scan]).argmax(1) for scan in scans]).numpy()
    table = np.zeros((256, len(NAMES)), np.int64)
    np.add.at(table, (label, guess), 1)
    return table[: len(NAMES)]
