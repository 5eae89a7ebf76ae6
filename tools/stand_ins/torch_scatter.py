"""The two functions of torch_scatter that FRNet calls, by torch's own operators.

torch_scatter is distributed as source only and takes half an hour to compile. Put this folder on PYTHONPATH to try
FRNet without it; on a GPU install the real library.
"""

import torch
from torch import Tensor


def scatter_max(
    src: Tensor, index: Tensor, dim: int = -1, out: None = None, dim_size: int | None = None
) -> list[Tensor]:
    """The largest value for each index, and None for its position; gradients flow to the value."""
    return [_reduce(src, index, dim, dim_size, "amax")]


def scatter_mean(src: Tensor, index: Tensor, dim: int = -1, out: None = None, dim_size: int | None = None) -> Tensor:
    """The mean of the values for each index; 0 for an index without values."""
    return _reduce(src, index, dim, dim_size, "mean")


def _reduce(src: Tensor, index: Tensor, dim: int, size: int | None, how: str) -> Tensor:
    size = int(index.max()) + 1 if size is None else size
    shape = list(src.shape)
    shape[dim] = size
    where = index.view([-1 if i == dim % src.ndim else 1 for i in range(src.ndim)]) if index.ndim == 1 else index
    zeros = torch.zeros(shape, dtype=src.dtype, device=src.device)
    return zeros.scatter_reduce(dim, where.expand_as(src), src, how, include_self=False)
