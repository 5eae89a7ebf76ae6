"""How weights are moved by their gradients.

To add one: write a function of (network, rate, betas, weight decay) that returns one or more of
torch's optimisers, which share the weights among them and all run at the schedule's rate; enter it
in ``OPTIMIZERS``.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.overrides import TorchFunctionMode

from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.generate.models.hdit.transformer import ContextAttention, SelfAttention
from lidar_synth.generate.models.layers import GatedFeedForward
from lidar_synth.lab.train.precision import faster_in_bfloat16

BLOCKS = (SelfAttention, ContextAttention, GatedFeedForward)
"""Modules whose linear layers Muon moves."""


def adamw(
    network: nn.Module, rate: float, betas: tuple[float, float], decay: float
) -> list[Optimizer]:
    """AdamW for all weights (Loshchilov and Hutter 2019)."""
    return [_adamw(list(network.parameters()), rate, betas, decay)]


def _adamw(
    weights: list[nn.Parameter], rate: float, betas: tuple[float, float], decay: float
) -> Optimizer:
    """AdamW in one pass over the weights, seven times faster on a CPU than in several, where every
    torch >= 2.4 has it."""
    fused = weights[0].device.type in ("cpu", "cuda")
    return torch.optim.AdamW(weights, rate, betas, weight_decay=decay, fused=fused)


def muon(
    network: nn.Module, rate: float, betas: tuple[float, float], decay: float
) -> list[Optimizer]:
    """Muon (Jordan et al. 2024) for the matrices of attention and feed-forward layers, scaled to
    AdamW's step (Liu et al. 2025, "Muon is scalable for LLM training"), so that both take one rate;
    AdamW for all else.

    Raises:
        ConfigError: for a network without such layers.
        LibraryError: with a torch before 2.9, which has no Muon.
    """
    if not hasattr(torch.optim, "Muon"):
        raise LibraryError(
            f"torch {torch.__version__}, which has no Muon",
            "torch >= 2.9",
            "Or optimizer: adamw.",
        )
    matrices = _matrices(network)
    if not matrices:
        raise ConfigError(
            f"optimizer 'muon' for {type(network).__name__}",
            "a transformer such as hdit, or adamw",
        )
    chosen = {id(p) for p in matrices}
    rest = [p for p in network.parameters() if id(p) not in chosen]
    kind = (
        torch.optim.Muon
        if matrices[0].device.type != "cpu" or faster_in_bfloat16()
        else _in_float32()
    )
    return [
        kind(matrices, rate, weight_decay=decay, adjust_lr_fn="match_rms_adamw"),
        _adamw(rest, rate, betas, decay),
    ]


def _in_float32() -> "type[torch.optim.Muon]":
    """Torch's Muon, which multiplies in bfloat16, made to multiply in float32."""

    class Muon(torch.optim.Muon):
        def step(self, closure: Any = None) -> Any:
            with _Float32():
                return super().step(closure)  # type: ignore[no-untyped-call]

    return Muon


class _Float32(TorchFunctionMode):
    """``Tensor.bfloat16()`` gives a copy in the tensor's own precision."""

    def __torch_function__(
        self,
        func: Any,
        types: Any,
        args: Any = (),
        kwargs: Any = None,
    ) -> Any:
        if func is Tensor.bfloat16:
            return args[0].clone()
        return func(*args, **(kwargs or {}))


def _matrices(network: nn.Module) -> list[Tensor]:
    """The weights of linear layers that belong to ``BLOCKS``."""
    layers = (
        layer
        for block in network.modules()
        if isinstance(block, BLOCKS)
        for layer in block.children()
    )
    return [layer.weight for layer in layers if isinstance(layer, nn.Linear)]


OPTIMIZERS: dict[
    str, Callable[[nn.Module, float, tuple[float, float], float], list[Optimizer]]
] = {
    "adamw": adamw,
    "muon": muon,
}
"""Optimisers by name."""
