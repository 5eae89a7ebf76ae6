"""The functions of torch_scatter that FRNet and Pointcept call, by torch's own operators.

torch_scatter is distributed as source only and takes half an hour to compile. Put this folder on
PYTHONPATH to try these trainers without it; on a GPU install the real library.
"""

import torch
from torch import Tensor


def scatter_max(
    src: Tensor,
    index: Tensor,
    dim: int = -1,
    out: None = None,
    dim_size: int | None = None,
) -> list[Tensor]:
    """The largest value for each index, and None for its position; gradients flow to the value."""
    return [_reduce(src, index, dim, dim_size, "amax")]


def scatter_mean(
    src: Tensor,
    index: Tensor,
    dim: int = -1,
    out: None = None,
    dim_size: int | None = None,
) -> Tensor:
    """The mean of the values for each index; 0 for an index without values."""
    return _reduce(src, index, dim, dim_size, "mean")


def segment_coo(
    src: Tensor,
    index: Tensor,
    out: None = None,
    dim_size: int | None = None,
    reduce: str = "sum",
) -> Tensor:
    """Reduce rows that belong to the same segment; ``index`` (N,) is sorted."""
    return _reduce(src, index, 0, dim_size, KINDS[reduce])


def segment_csr(
    src: Tensor, indptr: Tensor, out: None = None, reduce: str = "sum"
) -> Tensor:
    """Reduce rows of consecutive segments; segment i has the rows from ``indptr[i]`` to ``indptr[i
    + 1]``."""
    lengths = indptr.diff()
    index = torch.arange(len(lengths), device=src.device).repeat_interleave(lengths)
    return _reduce(src, index, 0, len(lengths), KINDS[reduce])


KINDS = {"sum": "sum", "add": "sum", "mean": "mean", "min": "amin", "max": "amax"}
"""torch's name of each reduction."""


def scatter_min(
    src: Tensor,
    index: Tensor,
    dim: int = -1,
    out: None = None,
    dim_size: int | None = None,
) -> tuple[Tensor, None]:
    """The smallest value for each index, and None for its position."""
    return _reduce(src, index, dim, dim_size, "amin"), None


def scatter_softmax(*args: object, **options: object) -> None:
    """Imported by Pointcept for its StratifiedTransformer, which needs further libraries for a
    GPU."""
    raise RuntimeError("install torch_scatter")


def _reduce(src: Tensor, index: Tensor, dim: int, size: int | None, how: str) -> Tensor:
    size = int(index.max()) + 1 if size is None else size
    shape = list(src.shape)
    shape[dim] = size
    where = (
        index.view([-1 if i == dim % src.ndim else 1 for i in range(src.ndim)])
        if index.ndim == 1
        else index
    )
    zeros = torch.zeros(shape, dtype=src.dtype, device=src.device)
    return zeros.scatter_reduce(dim, where.expand_as(src), src, how, include_self=False)
