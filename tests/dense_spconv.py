"""The sparse convolutions that Cylinder3D asks of spconv 1, on dense grids: right for small ones, on any machine."""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass
class SparseConvTensor:
    """Features (N, C) at the cells ``indices`` (N, 4) batch, x, y, z of a grid; ``made`` is what inverses look up."""

    features: Tensor
    indices: Tensor
    spatial_shape: Any
    batch_size: int
    made: dict[str, Any] = field(default_factory=dict)

    def dense(self) -> Tensor:
        """(B, C, X, Y, Z)"""
        grid = self.features.new_zeros(self.batch_size, *map(int, self.spatial_shape), self.features.shape[1])
        return grid.index_put(tuple(self.indices.long().T), self.features).movedim(-1, 1)

    def at(self, grid: Tensor, indices: Tensor) -> "SparseConvTensor":
        """The cells of a dense grid as such a tensor."""
        features = grid.movedim(1, -1)[tuple(indices.long().T)]
        return SparseConvTensor(features, indices, grid.shape[2:], self.batch_size, self.made)


def _three(value: Any) -> tuple[int, ...]:
    return tuple(value) if isinstance(value, tuple | list) else (value,) * 3


class _Convolution(nn.Module):
    def __init__(
        self, ins: int, outs: int, kernel_size: Any, stride: Any = 1, padding: Any = 0, bias: bool = True,
        indice_key: str = "",
    ) -> None:  # fmt: skip
        super().__init__()
        self.kernel, self.stride, self.padding = _three(kernel_size), _three(stride), _three(padding)
        self.key = indice_key
        self.weight = nn.Parameter(torch.empty(outs, ins, *self.kernel))
        nn.init.kaiming_uniform_(self.weight)
        self.bias = nn.Parameter(torch.zeros(outs)) if bias else None


class SubMConv3d(_Convolution):
    """Where there is something, and nowhere else."""

    def forward(self, x: SparseConvTensor) -> SparseConvTensor:
        same = tuple(k // 2 for k in self.kernel)
        return x.at(functional.conv3d(x.dense(), self.weight, self.bias, padding=same), x.indices)


class SparseConv3d(_Convolution):
    """Where anything is within reach."""

    def forward(self, x: SparseConvTensor) -> SparseConvTensor:
        x.made[self.key] = (x.indices, tuple(map(int, x.spatial_shape)), self.stride, self.padding)
        there = SparseConvTensor(torch.ones_like(x.features[:, :1]), x.indices, x.spatial_shape, x.batch_size).dense()
        cells = functional.max_pool3d(there, self.kernel, self.stride, self.padding)[:, 0].nonzero()
        grid = functional.conv3d(x.dense(), self.weight, self.bias, self.stride, self.padding)
        return x.at(grid, cells)


class SparseInverseConv3d(_Convolution):
    """Back to the cells that the convolution of the same key came from."""

    def forward(self, x: SparseConvTensor) -> SparseConvTensor:
        indices, shape, stride, padding = x.made[self.key]
        grid = x.dense()
        sizes = zip(shape, grid.shape[2:], stride, padding, self.kernel, strict=True)
        extra = tuple(want - ((have - 1) * s - 2 * p + k) for want, have, s, p, k in sizes)
        weight = self.weight.transpose(0, 1)
        return x.at(functional.conv_transpose3d(grid, weight, self.bias, stride, padding, extra), indices)
