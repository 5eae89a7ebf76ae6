"""Batch norms whose statistics are those of the samples of all processes.

Torch's ``SyncBatchNorm`` runs on GPUs only.
"""

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn


class SharedNorm(nn.BatchNorm2d):
    """A batch norm over the samples of all processes, which have equally many."""

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor
    momentum: float

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        if not self.training:
            return super().forward(x)
        y = x.float()
        mean = _mean(y)
        centred = y - mean
        variance = _mean(centred.square())
        with torch.no_grad():
            count = y.numel() // y.shape[1] * dist.get_world_size()
            unbiased = variance * count / (count - 1)
            for kept, now in ((self.running_mean, mean), (self.running_var, unbiased)):
                kept.lerp_(now.flatten(), self.momentum)
            self.num_batches_tracked += 1
        scale = self.weight.view(1, -1, 1, 1) * (variance + self.eps).rsqrt()
        return (centred * scale + self.bias.view(1, -1, 1, 1)).to(x.dtype)


def _mean(y: Tensor) -> Tensor:
    """(1, C, 1, 1) means over the samples of all processes."""
    total: Tensor = _Sum.apply(y.mean((0, 2, 3), keepdim=True))  # type: ignore[no-untyped-call]
    return total / dist.get_world_size()


class _Sum(torch.autograd.Function):
    """The sum over all processes; so is that of its gradients."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        total = x.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        total = gradient.clone()
        dist.all_reduce(total)
        return total


def share_norms(network: nn.Module) -> None:
    """Let the batch norms of a network take the samples of all processes."""
    for module in network.modules():
        if type(module) is nn.BatchNorm2d:
            module.__class__ = SharedNorm  # its weights, buffers and names stay
