"""The function of Pointcept's pointops that Sonata calls, by torch's own operators.

pointops is compiled for CUDA only (``libs/pointops`` of Pointcept). Put this folder on PYTHONPATH
to try Pointcept on a CPU; on a GPU install the real library.
"""

import torch
from torch import Tensor


def knn_query(
    nsample: int,
    xyz: Tensor,
    offset: Tensor,
    new_xyz: Tensor | None = None,
    new_offset: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The nearest points of the same sample.

    Args:
        nsample: K, how many.
        xyz: (N, 3) points of all samples.
        offset: (B,) where each sample ends.
        new_xyz: (M, 3) points whose neighbours are sought; by default ``xyz``.
        new_offset: (B,) where each sample of ``new_xyz`` ends.

    Returns:
        (M, K) int32 indices into ``xyz``, -1 where a sample has fewer points, and their distances.
    """
    new_xyz, new_offset = (
        (xyz, offset)
        if new_xyz is None or new_offset is None
        else (new_xyz, new_offset)
    )
    index = torch.full(
        (len(new_xyz), nsample), -1, dtype=torch.int32, device=xyz.device
    )
    distance = torch.full((len(new_xyz), nsample), 1e5, device=xyz.device)
    ends, new_ends = ([0, *each.tolist()] for each in (offset, new_offset))
    for start, end, first, last in zip(
        ends, ends[1:], new_ends, new_ends[1:], strict=False
    ):
        count = min(nsample, end - start)
        for chunk in torch.split(torch.arange(first, last, device=xyz.device), 4096):
            near = torch.cdist(new_xyz[chunk], xyz[start:end]).topk(
                count, largest=False
            )
            index[chunk, :count] = (near.indices + start).int()
            distance[chunk, :count] = near.values
    return index, distance
