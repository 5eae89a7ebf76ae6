"""Random numbers that are a function of (seed, index) alone.

The noise of scan ``index`` under ``seed`` is the same on every device, in every batch and in every
order. So a teacher and its student, or two checkpoints, can be compared from the same noise, and a
bake can be resumed or distributed over machines. The generator is counter-based: Philox4x32 with
ten rounds (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011), whose output
depends only on its 64-bit key (the seed) and its 128-bit counter::

    counter = (block, index mod 2^32, index div 2^32, stream)

A block is four 32-bit words. Element ``e`` of a scan (row-major) comes from word ``e mod 4`` of
block ``e div 4``, so that a smaller shape is a prefix of a larger one. Each kind of random number
has its own stream.

torch is imported by what returns tensors: ``keyed_rng`` works without it.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

_ROUNDS = 10
_MULTIPLIERS = 0xD2511F53, 0xCD9E8D57
_KEY_STEPS = 0x9E3779B9, 0xBB67AE85
_WORD = 0xFFFFFFFF
# streams
_GAUSSIAN = 0
_UNIFORM = 1
_KEYS = 2


def gaussian(
    seed: int,
    indices: Sequence[int],
    shape: Sequence[int],
    device: "torch.device | str" = "cpu",
    dtype: "torch.dtype | None" = None,
) -> "Tensor":
    """Standard normal noise, one sample per index.

    The noise is computed in float64 by the Box-Muller transform and rounded once, so that devices
    agree up to float rounding.

    Args:
        seed: 0 <= seed < 2^64.
        indices: B numbers, 0 <= index < 2^63, in any order.
        shape: shape of one sample, such as (C, H, W).
        device: the device of the result.
        dtype: floating type of the result; None = float32.

    Returns:
        (B, *shape) noise; sample b depends on ``seed`` and ``indices[b]`` only.

    Raises:
        ConfigError: on a seed, an index or a shape out of range.

    Example:
        >>> import torch
        >>> from lidar_synth.noise import gaussian
        >>> noise = gaussian(seed=0, indices=[7, 3], shape=(2, 64, 1024))
        >>> noise.shape
        torch.Size([2, 2, 64, 1024])
        >>> torch.equal(gaussian(seed=0, indices=[3], shape=(2, 64, 1024))[0], noise[1])
        True
    """
    import torch

    words, count = _words(seed, indices, shape, device, _GAUSSIAN)
    radius = ((words[::2].double() + 0.5) * 2.0**-32).log_().mul_(-2).sqrt_()
    angle = words[1::2].double() * (2 * math.pi * 2.0**-32)
    lanes = torch.stack([radius * angle.cos(), radius * angle.sin()], 1).flatten(0, 1)
    return _samples(lanes.to(dtype or torch.float32), shape, count, device)


def uniform(
    seed: int,
    indices: Sequence[int],
    shape: Sequence[int] = (),
    device: "torch.device | str" = "cpu",
) -> "Tensor":
    """Uniform float32 numbers in the open interval (0, 1), one sample per index.

    The values are odd multiples of 2^-24, exact in float32, so that every device gives the same
    bits. They are independent of ``gaussian`` with the same seed and index.

    Args:
        seed: 0 <= seed < 2^64.
        indices: B numbers, 0 <= index < 2^63, in any order.
        shape: shape of one sample; () gives one number per index.
        device: the device of the result.

    Returns:
        (B, *shape) numbers; sample b depends on ``seed`` and ``indices[b]`` only.

    Raises:
        ConfigError: on a seed, an index or a shape out of range.
    """
    words, count = _words(seed, indices, shape, device, _UNIFORM)
    # Only 23 bits are used: with 24, the added half would round the largest value to 1.
    return _samples(((words >> 9).float() + 0.5) * 2.0**-23, shape, count, device)


def keyed_rng(*key: int) -> np.random.Generator:
    """A numpy generator whose numbers depend only on its key, such as (seed, epoch, position).

    Args:
        key: integers, 0 <= k < 2^64. Different keys, also of different length, give independent
            numbers.

    Raises:
        ConfigError: on an integer out of range.
    """
    if any(not 0 <= k < 2**64 for k in key):
        raise ConfigError(
            f"the key {key} of a random generator", "integers, 0 <= k < 2^64"
        )
    # Two words per integer, and the number of integers first: numpy's SeedSequence treats (1,) and
    # (1, 0) as equal.
    return np.random.default_rng(
        [len(key), *(word for k in key for word in (k & _WORD, k >> 32))]
    )


def key_words(seed: int, index: int, count: int) -> NDArray[np.uint64]:
    """Random 64-bit keys, for keyed functions such as permutations.

    Args:
        seed: 0 <= seed < 2^64.
        index: 0 <= index < 2^63.
        count: number of keys.

    Returns:
        (count,) uint64, independent of ``gaussian`` and ``uniform`` with the same seed and index.

    Raises:
        ConfigError: on a seed, an index or a count out of range.
    """
    words, size = _words(seed, [index], (2 * count,), "cpu", _KEYS)
    halves = _samples(words, (size,), size, "cpu").numpy().astype(np.uint64)[0]
    keys: NDArray[np.uint64] = halves[::2] | halves[1::2] << np.uint64(32)
    return keys


def philox(counter: "Tensor", seed: int) -> "Tensor":
    """The counter-based generator Philox4x32-10.

    Args:
        counter: (4, ...) int64, words 0 .. 2^32 - 1, the least significant one first.
        seed: the key, 0 <= seed < 2^64.

    Returns:
        (4, ...) int64, random words 0 .. 2^32 - 1.
    """
    import torch

    c0, c1, c2, c3 = counter.unbind()
    key0 = seed & _WORD
    key1 = seed >> 32
    for _ in range(_ROUNDS):
        # The product of two 32-bit words needs 64 bits. Signed overflow wraps around and the shift
        # extends the sign, so the upper half is masked to 32 bits. The lower half is masked one
        # round later: only xor is applied before.
        product0 = c0 * _MULTIPLIERS[0]
        product1 = c2 * _MULTIPLIERS[1]
        c0 = (product1 >> 32).bitwise_xor_(c1).bitwise_xor_(key0).bitwise_and_(_WORD)
        c1 = product1
        c2 = (product0 >> 32).bitwise_xor_(c3).bitwise_xor_(key1).bitwise_and_(_WORD)
        c3 = product0
        key0 = (key0 + _KEY_STEPS[0]) & _WORD
        key1 = (key1 + _KEY_STEPS[1]) & _WORD
    return torch.stack([c0, c1 & _WORD, c2, c3 & _WORD])


def _words(
    seed: int,
    indices: Sequence[int],
    shape: Sequence[int],
    device: "torch.device | str",
    stream: int,
) -> "tuple[Tensor, int]":
    """(4, B, blocks) random 32-bit words, and the number of elements of one sample."""
    import torch

    _check(seed, indices, shape)
    count = math.prod(shape)
    # CPU and CUDA have float64; for other devices the noise is computed on the CPU and copied.
    place = device if torch.device(device).type == "cuda" else "cpu"
    blocks = torch.arange(-(-count // 4), device=place)
    index = torch.tensor(list(indices), dtype=torch.int64, device=place)[:, None]
    counter = [
        word.expand(len(index), len(blocks))
        for word in (blocks, index & _WORD, index >> 32, blocks.new_tensor(stream))
    ]
    return philox(torch.stack(counter), seed), count


def check_seed(seed: int) -> None:
    """Check that ``seed`` is an integer, 0 <= seed < 2^64.

    Raises:
        ConfigError: on any other value.
    """
    if not isinstance(seed, SupportsIndex) or not 0 <= seed < 2**64:
        raise ConfigError(f"seed {seed!r}", "0 <= seed < 2^64, an integer")


def _check(seed: int, indices: Sequence[int], shape: Sequence[int]) -> None:
    check_seed(seed)
    for i in indices:
        if not isinstance(i, SupportsIndex) or not 0 <= i < 2**63:
            raise ConfigError(f"index {i}", "0 <= index < 2^63, an integer")
    if min(shape, default=1) < 1 or math.prod(shape) >= 2**34:
        raise ConfigError(
            f"noise of shape {tuple(shape)}",
            "positive sizes, less than 2^34 elements in all",
        )


def _samples(
    lanes: "Tensor", shape: Sequence[int], count: int, device: "torch.device | str"
) -> "Tensor":
    """Reshape words (4, B, blocks) to samples (B, *shape) on ``device``."""
    return lanes.movedim(0, -1).flatten(1)[:, :count].reshape(-1, *shape).to(device)
