"""Sparse convolution by sorting, gathering and matrix products, with the weights of torchsparse
1.4.

Voxels (N, 3) are integers from 0, sorted by x, then y, then z. A kernel is (K, C_in, C_out) for K
offsets::

    size 3    offsets -1, 0, 1, x fastest:    k = 9 (z + 1) + 3 (y + 1) + (x + 1)
    size 2    offsets 0, 1, z fastest:        k = 4 x + 2 y + z        (stride 2, and its transpose)
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lidar_synth.errors import DataError

_BITS = 21
"""Bits of a coordinate in a key."""
_CENTRE = 13
"""Position of the offset (0, 0, 0) in a kernel of size 3."""


class Pairs(NamedTuple):
    """Which voxel contributes to which, for each offset of a kernel.

    Args:
        source, target: (P,) indices of voxels, grouped by offset.
        sizes: number of pairs of each offset.
    """

    source: Tensor
    target: Tensor
    sizes: list[int]

    def reversed(self) -> "Pairs":
        """The pairs of the transposed convolution."""
        return Pairs(self.target, self.source, self.sizes)


class SparseLevel(NamedTuple):
    """The voxels of one resolution.

    Args:
        voxels: (N, 3) int64, in units of this level's voxels.
        neighbours: pairs of a kernel of size 3.
        children: pairs of a kernel of size 2 from the finer level; none at the finest.
        parent: (voxels of the finer level,) the voxel that contains each; none at the finest.
    """

    voxels: Tensor
    neighbours: Pairs
    children: Pairs | None = None
    parent: Tensor | None = None


def keys(voxels: Tensor) -> Tensor:
    """(N,) int64, in the order of x, then y, then z; coordinates from -1 to 2^21 - 2.

    Raises:
        DataError: on coordinates outside.
    """
    if len(voxels) and not (
        int(voxels.min()) >= -1 and int(voxels.max()) < 2**_BITS - 1
    ):
        raise DataError(
            f"voxels from {int(voxels.min())} to {int(voxels.max())}",
            "a scan of less than 100 km",
        )
    x, y, z = (voxels + 1).unbind(1)
    return (x << 2 * _BITS) | (y << _BITS) | z


def voxels_of(packed: Tensor) -> Tensor:
    """The voxels (N, 3) of ``keys``."""
    mask = 2**_BITS - 1
    return (
        torch.stack([packed >> 2 * _BITS, (packed >> _BITS) & mask, packed & mask], 1)
        - 1
    )


def find(wanted: Tensor, among: Tensor) -> Tensor:
    """Position of each wanted key in sorted keys; -1 = none."""
    position = torch.searchsorted(among, wanted).clamp(max=len(among) - 1)
    return torch.where(among[position] == wanted, position, -1)


def neighbours(voxels: Tensor) -> Pairs:
    """The pairs of a kernel of size 3 over sorted voxels. An offset and its opposite have the same
    pairs, exchanged."""
    sorted_keys = keys(voxels)
    near = (-1, 0, 1)
    steps = torch.tensor([(x, y, z) for z in near for y in near for x in near])
    shifts = (steps[:, 0] << 2 * _BITS) + (steps[:, 1] << _BITS) + steps[:, 2]
    before = []
    for shift in shifts[:_CENTRE]:
        found = find(sorted_keys + shift, sorted_keys)
        target = (found >= 0).nonzero()[:, 0]
        before.append((found[target], target))
    all_of_them = torch.arange(len(voxels))
    pairs = [
        *before,
        (all_of_them, all_of_them),
        *((t, s) for s, t in reversed(before)),
    ]
    sources, targets = zip(*pairs, strict=True)
    return Pairs(torch.cat(sources), torch.cat(targets), list(map(len, sources)))


def pyramid(voxels: Tensor, depth: int) -> list[SparseLevel]:
    """The levels of a network: each halves the resolution of the one before.

    Args:
        voxels: (N, 3) int64 from 0, unique and sorted.
        depth: number of levels.
    """
    levels = [SparseLevel(voxels, neighbours(voxels))]
    for _ in range(depth - 1):
        fine = levels[-1].voxels
        packed, parent = torch.unique(keys(fine >> 1), return_inverse=True)
        coarse = voxels_of(packed)
        x, y, z = (fine & 1).unbind(1)
        offset = 4 * x + 2 * y + z
        order = offset.argsort(stable=True)
        children = Pairs(
            order, parent[order], torch.bincount(offset, minlength=8).tolist()
        )
        levels.append(SparseLevel(coarse, neighbours(coarse), children, parent))
    return levels


def convolve(features: Tensor, kernel: Tensor, pairs: Pairs, count: int) -> Tensor:
    """Sum of the contributions of all pairs.

    Args:
        features: (N, C_in).
        kernel: (K, C_in, C_out).
        pairs: for each of the K offsets.
        count: number of output voxels M.

    Returns:
        (M, C_out).
    """
    # then each voxel also contributes to itself, without a gather
    own = kernel.shape[0] == 27
    total = (
        features @ kernel[_CENTRE]
        if own
        else features.new_zeros(count, kernel.shape[2])
    )
    start = 0
    for k, size in enumerate(pairs.sizes):
        part = slice(start, start + size)
        start += size
        if size and not (own and k == _CENTRE):
            total.index_add_(
                0,
                pairs.target[part],
                features.index_select(0, pairs.source[part]) @ kernel[k],
            )
    return total


class Convolution(nn.Module):
    """A sparse convolution without bias; a kernel of size 1 is a linear layer.

    Args:
        inputs: channels C_in.
        outputs: channels C_out.
        size: of the kernel: 1, 2 or 3.
    """

    def __init__(self, inputs: int, outputs: int, size: int) -> None:
        super().__init__()
        shape = (inputs, outputs) if size == 1 else (size**3, inputs, outputs)
        self.kernel = nn.Parameter(torch.zeros(shape))

    def forward(
        self, features: Tensor, pairs: Pairs | None = None, count: int | None = None
    ) -> Tensor:
        """(N, C_in) to (M, C_out); M is N by default."""
        if pairs is None:
            return features @ self.kernel
        return convolve(
            features, self.kernel, pairs, len(features) if count is None else count
        )


def mean_in(features: Tensor, voxel: Tensor, count: int) -> Tensor:
    """(N, C) features of points to (count, C) means over the points of each voxel; ``voxel`` (N,)
    is its index."""
    sums = features.new_zeros(count, features.shape[1]).index_add_(0, voxel, features)
    return sums / torch.bincount(voxel, minlength=count).clamp(min=1)[:, None]


def interpolate(features: Tensor, coarse: Tensor, points: Tensor, size: int) -> Tensor:
    """Trilinear interpolation of the features of coarse voxels at points; missing voxels have no
    weight.

    Args:
        features: (M, C) of the voxels.
        coarse: (M, 3) sorted voxels, in units of ``size``.
        points: (N, 3) int64, in units of the finest voxels.
        size: of a coarse voxel, in finest voxels: a power of 2.

    Returns:
        (N, C).
    """
    sorted_keys = keys(coarse)
    corner = points // size
    share = (points % size).float() / size
    total = features.new_zeros(len(points), features.shape[1])
    sum_of_weights = features.new_zeros(len(points))
    for step in [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]:
        upper = torch.tensor(step)
        found = find(keys(corner + upper), sorted_keys)
        weight = torch.where(upper.bool(), share, 1 - share).prod(1) * (found >= 0)
        total += features[found.clamp(min=0)] * weight[:, None]
        sum_of_weights += weight
    return total / (sum_of_weights + 1e-8)[:, None]
