"""LiDM's networks of voxels (https://github.com/hancyran/LiDAR-Diffusion): MinkowskiNet (Choy et
al., CVPR 2019) and SPVCNN (Tang et al., ECCV 2020), in the form and with the parameter names of
2DPASS and torchsparse 1.4.

A cloud becomes voxels of 5 cm, each with the position of its first point; the remission is -1.
Features are averaged over rings of distance. R2Flow and R3DPA use the same weights.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from lidar_synth.errors import ConfigError
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.extractors.archive import Archive, load_weights
from lidar_synth.lab.evaluate.extractors.inputs import FURTHEST, preparation
from lidar_synth.lab.evaluate.extractors.per_scan import PerScan, some
from lidar_synth.lab.evaluate.extractors.pooling import mean_over_rings
from lidar_synth.lab.evaluate.extractors.sparse import (
    Convolution,
    Pairs,
    SparseLevel,
    interpolate,
    keys,
    mean_in,
    pyramid,
    voxels_of,
)

VOXEL = 0.05
"""Size of a voxel, metres."""


class _SparseBlock(nn.Module):
    """Convolution, normalisation, ReLU; ``net`` names them as in the archives."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            Convolution(inputs, outputs, 2), nn.BatchNorm1d(outputs)
        )

    def forward(self, features: Tensor, pairs: Pairs, count: int) -> Tensor:
        return F.relu(self.net[1](self.net[0](features, pairs, count)))


class _SparseResidual(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        first = Convolution(inputs, outputs, 3)
        second = Convolution(outputs, outputs, 3)
        self.net = nn.Sequential(
            first,
            nn.BatchNorm1d(outputs),
            nn.Identity(),
            second,
            nn.BatchNorm1d(outputs),
        )
        own = inputs == outputs
        self.downsample = (
            nn.Sequential()
            if own
            else nn.Sequential(Convolution(inputs, outputs, 1), nn.BatchNorm1d(outputs))
        )

    def forward(self, features: Tensor, pairs: Pairs) -> Tensor:
        first, normalise, _, second, normalise_again = self.net
        x = F.relu(normalise(first(features, pairs)))
        return F.relu(normalise_again(second(x, pairs)) + self.downsample(features))


class MinkowskiNet(nn.Module):
    """A U-Net of voxels with five resolutions.

    Args:
        widths: channels of the stem, the four stages down and the four stages up.
        inputs: channels of the input.
        classes: number of classes.
    """

    def __init__(
        self, widths: Sequence[int], inputs: int = 4, classes: int = 20
    ) -> None:
        super().__init__()
        w = list(widths)
        self.stem = nn.Sequential(
            Convolution(inputs, w[0], 3),
            nn.BatchNorm1d(w[0]),
            nn.Identity(),
            Convolution(w[0], w[0], 3),
            nn.BatchNorm1d(w[0]),
        )
        for i in range(4):
            down = nn.Sequential(
                _SparseBlock(w[i], w[i]),
                _SparseResidual(w[i], w[i + 1]),
                _SparseResidual(w[i + 1], w[i + 1]),
            )
            self.add_module(f"stage{i + 1}", down)
            out = w[i + 5]
            after = nn.Sequential(
                _SparseResidual(out + w[3 - i], out), _SparseResidual(out, out)
            )
            self.add_module(
                f"up{i + 1}", nn.ModuleList([_SparseBlock(w[i + 4], out), after])
            )
        self.classifier = nn.Sequential(nn.Linear(w[8], classes))

    def forward(self, features: Tensor, levels: list[SparseLevel]) -> Tensor:
        """(N, inputs) features of the voxels of the first of five levels to (N, widths[8])."""
        maps = [self._stem(features, levels[0])]
        for i in range(4):
            maps.append(self._down(i, maps[-1], levels))
        x = maps[4]
        for i in range(4):
            x = self._up(i, x, maps[3 - i], levels)
        return x

    def _stem(self, features: Tensor, level: SparseLevel) -> Tensor:
        first, normalise, _, second, normalise_again = self.stem
        x = F.relu(normalise(first(features, level.neighbours)))
        return F.relu(normalise_again(second(x, level.neighbours)))

    def _down(self, i: int, x: Tensor, levels: list[SparseLevel]) -> Tensor:
        coarse = levels[i + 1]
        block, *residuals = self.get_submodule(f"stage{i + 1}").children()
        x = block(x, coarse.children, len(coarse.voxels))
        for residual in residuals:
            x = residual(x, coarse.neighbours)
        return x

    def _up(
        self,
        i: int,
        x: Tensor,
        skip: Tensor,
        levels: list[SparseLevel],
    ) -> Tensor:
        children = levels[4 - i].children
        fine = levels[3 - i]
        assert children is not None  # only the finest level has none
        block, residuals = self.get_submodule(f"up{i + 1}").children()
        x = torch.cat([block(x, children.reversed(), len(fine.voxels)), skip], 1)
        for residual in residuals.children():
            x = residual(x, fine.neighbours)
        return x


class SPVCNN(MinkowskiNet):
    """MinkowskiNet with a second branch of points, which meet the voxels at three resolutions.

    The points are the finest voxels, so that at that resolution both branches have the same places.
    """

    def __init__(
        self, widths: Sequence[int], inputs: int = 4, classes: int = 20
    ) -> None:
        super().__init__(widths, inputs, classes)
        pairs = [(widths[0], widths[4]), (widths[4], widths[6]), (widths[6], widths[8])]
        self.point_transforms = nn.ModuleList(
            nn.Sequential(nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU())
            for a, b in pairs
        )

    def forward(self, features: Tensor, levels: list[SparseLevel]) -> Tensor:
        """(N, inputs) features of the voxels of the first of five levels to (N, widths[8])."""
        points = levels[0].voxels
        maps = [self._stem(features, levels[0])]
        for i in range(4):
            maps.append(self._down(i, maps[-1], levels))
        branch = maps[0]
        x = maps[4]
        for i in range(4):
            if i in (0, 2):
                level = levels[4 - i]
                size = 2 ** (4 - i)
                branch = self.point_transforms[i // 2](branch) + interpolate(
                    x, level.voxels, points, size
                )
                x = mean_in(branch, _containing(levels, 4 - i), len(level.voxels))
            x = self._up(i, x, maps[3 - i], levels)
        last: Tensor = x + self.point_transforms[2](branch)
        return last


def _containing(levels: list[SparseLevel], depth: int) -> Tensor:
    """The voxel of a level that contains each finest voxel."""
    index = torch.arange(len(levels[0].voxels))
    for level in levels[1 : depth + 1]:
        assert level.parent is not None  # only the finest level has none
        index = level.parent[index]
    return index


def voxelise(cloud: NDArray[np.float32]) -> tuple[Tensor, Tensor]:
    """The voxels of a cloud and their features.

    Args:
        cloud: (N, 3) float32, metres.

    Returns:
        (M, 3) int64 voxels from 0, sorted, and (M, 4) float32: x, y, z of the first point in each,
        and -1.
    """
    rounded = np.round(cloud / np.float32(VOXEL))
    packed = keys(torch.from_numpy((rounded - rounded.min(0)).astype(np.int64)))
    voxels, first = np.unique(packed.numpy(), return_index=True)
    features = np.column_stack([cloud[first], np.full(len(first), -1, np.float32)])
    return voxels_of(torch.from_numpy(voxels)), torch.from_numpy(features)


NETWORKS = {"minkowski": MinkowskiNet, "spvcnn": SPVCNN}
"""Networks by name."""


def load_voxel_network(path: Path, prepared: str, network: str) -> PerScan:
    """An extractor from the archive of LiDM or of R2Flow; see ``load_extractor``.

    Args:
        path: the archive, with ``config.yaml`` and ``model.ckpt``.
        prepared: a name of ``PREPARATIONS``.
        network: a name of ``NETWORKS``.
    """
    archive = Archive(path, "LiDM or R2Flow")
    settings = archive.yaml("config.yaml")
    try:
        given = settings["model_params"]
        widths = [int(given["cr"] * width) for width in given["layer_num"]]
        net = NETWORKS[network](widths, given["input_dims"], given["num_class"])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ConfigError(
            f"{path}: config.yaml lacks or misstates {error}",
            "the settings of LiDM's network",
        ) from error
    content = archive.weights("model.ckpt")
    state = content.get("state_dict") if isinstance(content, dict) else None
    load_weights(net, state, str(path / "model.ckpt"), extra=True)
    net.eval()
    inputs = preparation(prepared)

    def describe(scan: Scan, generated: bool) -> Tensor:
        cloud = inputs.cloud(scan, generated)
        some(cloud)
        voxels, features = voxelise(cloud)
        return mean_over_rings(
            net(features, pyramid(voxels, 5)), voxels, VOXEL, FURTHEST
        )

    return PerScan(describe)
