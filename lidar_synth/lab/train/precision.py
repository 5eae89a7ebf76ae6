"""The precision that a training computes in."""

import time
from functools import cache

import torch
from torch import nn

from lidar_synth.generate.devices import available_devices

_SIDE = 512
_ROUNDS = 3


def choose_precision(asked: str) -> str:
    """The precision for a configuration's: "bf16" only on a GPU, or a processor that is faster with
    it.

    Args:
        asked: "no" = float32, or "bf16".
    """
    return asked if asked == "no" or has_gpu() or faster_in_bfloat16() else "no"


def has_gpu() -> bool:
    """Whether torch can compute on a GPU."""
    return len(available_devices()) > 1


@cache
def faster_in_bfloat16() -> bool:
    """Whether this machine's processor multiplies matrices faster in bfloat16 than in float32.

    Those without instructions for it are ten times slower, those with AMX several times faster.
    Measured once in a process, in some hundredths of a second.
    """
    return _seconds(torch.bfloat16) < _seconds(torch.float32)


def _seconds(dtype: torch.dtype) -> float:
    """The least processor time of a product; other programs of the machine do not change it."""
    matrix = torch.ones(_SIDE, _SIDE, dtype=dtype)
    times = []
    for _ in range(_ROUNDS):
        start = time.process_time()
        matrix @ matrix.T
        times.append(time.process_time() - start)
    return min(times)


def convert_products(velocity: nn.Module) -> None:
    """Convert the weights of a frozen network's products to bfloat16, once.

    Autocast would convert them in each of a teacher's evaluations; under it, the result is the
    same, to the bit. The first layer of a transformer stays: it tells the precision of all else.
    """
    for name, layer in velocity.named_modules():
        if isinstance(layer, nn.Linear | nn.Conv2d) and name != "tokenize":
            layer.to(torch.bfloat16)
