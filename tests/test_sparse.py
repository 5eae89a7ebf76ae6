"""Sparse convolution against dense convolution, and the order of torchsparse's offsets by hand."""

from itertools import pairwise

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from lidar_synth.errors import DataError
from lidar_synth.lab.evaluate.extractors.pooling import mean_over_bands, mean_over_rings
from lidar_synth.lab.evaluate.extractors.sparse import (
    convolve,
    interpolate,
    keys,
    mean_in,
    neighbours,
    pyramid,
)
from lidar_synth.lab.evaluate.extractors.voxel_networks import voxelise

SIDE = 12


def random_voxels(count: int = 300, seed: int = 0) -> Tensor:
    drawn = torch.from_numpy(np.random.default_rng(seed).integers(0, SIDE, (count, 3)))
    return torch.unique(drawn, dim=0)


def dense(voxels: Tensor, features: Tensor, side: int = SIDE) -> Tensor:
    grid = torch.zeros(features.shape[1], side, side, side)
    grid[:, voxels[:, 0], voxels[:, 1], voxels[:, 2]] = features.T
    return grid[None]


def at(grid: Tensor, voxels: Tensor) -> Tensor:
    return grid[0][:, voxels[:, 0], voxels[:, 1], voxels[:, 2]].T


def test_a_kernel_of_size_3_is_a_dense_convolution() -> None:
    voxels = random_voxels()
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(len(voxels), 5, generator=generator)
    kernel = torch.randn(27, 5, 7, generator=generator)
    # (z, y, x, in, out): x is the fastest.
    weight = kernel.view(3, 3, 3, 5, 7).permute(4, 3, 2, 1, 0)
    expected = at(F.conv3d(dense(voxels, features), weight, padding=1), voxels)
    torch.testing.assert_close(
        convolve(features, kernel, neighbours(voxels), len(voxels)), expected
    )


def test_a_kernel_of_size_2_and_its_transpose_are_dense_convolutions() -> None:
    fine = random_voxels(seed=1)
    generator = torch.Generator().manual_seed(1)
    level = pyramid(fine, 2)[1]
    features = torch.randn(len(fine), 5, generator=generator)
    kernel = torch.randn(8, 5, 7, generator=generator)
    # (x, y, z, in, out): z is the fastest.
    weight = kernel.view(2, 2, 2, 5, 7).permute(4, 3, 0, 1, 2)
    assert level.children is not None
    coarse = convolve(features, kernel, level.children, len(level.voxels))
    torch.testing.assert_close(
        coarse, at(F.conv3d(dense(fine, features), weight, stride=2), level.voxels)
    )
    back = torch.randn(8, 7, 4, generator=generator)
    weight = back.view(2, 2, 2, 7, 4).permute(3, 4, 0, 1, 2)
    expected = at(
        F.conv_transpose3d(dense(level.voxels, coarse, SIDE // 2), weight, stride=2),
        fine,
    )
    torch.testing.assert_close(
        convolve(coarse, back, level.children.reversed(), len(fine)), expected
    )


@pytest.mark.parametrize(
    ("k", "offset"),
    [
        (0, (-1, -1, -1)),
        (2, (1, -1, -1)),
        (12, (-1, 0, 0)),
        (13, (0, 0, 0)),
        (16, (0, 1, 0)),
        (22, (0, 0, 1)),
        (26, (1, 1, 1)),
    ],
)
def test_the_offsets_of_size_3_by_hand(k: int, offset: tuple[int, int, int]) -> None:
    """The output at a voxel takes from the voxel at ``offset`` from it with the weights of index
    ``k``."""
    here = torch.tensor((4, 4, 4))
    voxels = torch.unique(torch.stack([here, here + torch.tensor(offset)]), dim=0)
    values = torch.arange(1.0, len(voxels) + 1)[:, None]
    kernel = torch.zeros(27, 1, 1)
    kernel[k] = 1
    position = {tuple(v): i for i, v in enumerate(voxels.tolist())}
    out = convolve(values, kernel, neighbours(voxels), len(voxels))
    assert (
        out[position[4, 4, 4]]
        == values[position[tuple((here + torch.tensor(offset)).tolist())]]
    )
    assert len(voxels) == 1 or out.count_nonzero() == 1


@pytest.mark.parametrize(
    ("k", "place"),
    [(0, (0, 0, 0)), (1, (0, 0, 1)), (2, (0, 1, 0)), (4, (1, 0, 0)), (6, (1, 1, 0))],
)
def test_the_offsets_of_size_2_by_hand(k: int, place: tuple[int, int, int]) -> None:
    level = pyramid(torch.tensor([place]) + 6, 2)[1]
    assert level.children is not None and level.voxels.tolist() == [[3, 3, 3]]
    assert [i for i, size in enumerate(level.children.sizes) if size] == [k]


def test_all_levels_hold_the_halved_voxels() -> None:
    levels = pyramid(random_voxels(seed=2), 4)
    for fine, coarse in pairwise(levels):
        assert torch.equal(coarse.voxels, torch.unique(fine.voxels // 2, dim=0))
        assert coarse.parent is not None and torch.equal(
            coarse.voxels[coarse.parent], fine.voxels // 2
        )


def test_interpolation_is_exact_on_a_full_grid_and_leaves_missing_voxels_out() -> None:
    coarse = torch.cartesian_prod(*[torch.arange(4)] * 3)
    slope = torch.tensor([1.0, 2.0, 3.0])
    points = torch.from_numpy(np.random.default_rng(0).integers(0, 3 * 8, (50, 3)))
    found = interpolate((coarse * 8.0 @ slope)[:, None], coarse, points, 8)[:, 0]
    # A linear function is interpolated exactly.
    torch.testing.assert_close(found, points.float() @ slope)
    two = torch.tensor([(0, 0, 0), (1, 0, 0)])
    found = interpolate(
        torch.tensor([[10.0], [20.0]]), two, torch.tensor([(2, 6, 7), (8, 0, 0)]), 8
    )
    torch.testing.assert_close(found[:, 0], torch.tensor([12.5, 20.0]))


def test_means_in_voxels() -> None:
    found = mean_in(torch.tensor([[1.0], [3.0], [5.0]]), torch.tensor([1, 1, 0]), 3)
    assert found[:, 0].tolist() == [5, 2, 0]


def test_voxels_hold_their_first_point_and_no_remission() -> None:
    cloud = np.array([(1.0, 2, 3), (1.01, 2, 3), (0.0, 2, 3), (1.2, 2, 3)], np.float32)
    voxels, features = voxelise(cloud)
    assert voxels.tolist() == [[0, 0, 0], [20, 0, 0], [24, 0, 0]]
    np.testing.assert_array_equal(
        features.numpy(), np.c_[cloud[[2, 0, 3]], [-1, -1, -1]]
    )


def test_voxels_too_far_apart_are_refused() -> None:
    with pytest.raises(DataError, match="100 km"):
        keys(torch.tensor([(0, 0, 0), (1 << 21, 0, 0)]))


def test_rings_and_bands_by_hand() -> None:
    voxels = torch.tensor(
        [(0, 0, 0), (0, 200, 0), (0, -200, 0), (4000, 0, 0), (-4000, 0, 0)]
    )
    features = torch.tensor([[1.0], [2.0], [4.0], [8.0], [16.0]])
    # Distances 0, 10, 10, 200, 200 m from the centre.
    found = mean_over_rings(features, voxels, 0.05, 56.0)
    expected = torch.zeros(16)
    expected[0] = 1
    expected[int((10 - 4) / (52 / 16))] = 3
    assert torch.equal(found, expected)
    image = torch.arange(32.0)[None, :, None].expand(2, 32, 8)
    assert torch.equal(mean_over_bands(image), torch.arange(0.5, 32, 2).repeat(2))
