"""Training batches as a function of their position alone.

A run requests samples by their position in one endless sequence. A sample (scan, rotation,
mirroring, noise, time) is a function of (seed, position) only, so that a resumed run, or one with
another number of processes, sees the same data.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.errors import ConfigError
from lidar_synth.generate.codec import Codec
from lidar_synth.generate.conditions import CONDITIONS, blank
from lidar_synth.geometry.normalize import TensorFormat
from lidar_synth.lab.train.cache import ImageCache
from lidar_synth.noise import gaussian, uniform

_TRAINING = 1 << 62
"""Offset of a run's seed: training noise differs from the noise of scans that are sampled with the
same seed."""


class Batch(NamedTuple):
    """One batch of training data, from which a task makes its example.

    Args:
        y0: (B, C, H, W) data: tensors in [-1, 1], or latents.
        y1: (B, C, H, W) standard normal noise.
        u: (B,) uniform numbers in (0, 1), for the time.
        cond: (B, ...) conditions as they are stored, uint8; None for an unconditional model.
    """

    y0: Tensor
    y1: Tensor
    u: Tensor
    cond: Tensor | None = None


@dataclass(frozen=True)
class Conditioning:
    """How samples get their conditions.

    Args:
        name: of ``CONDITIONS``.
        dropout: share of samples with a blank condition, so that the model can be guided.
        reduction: share of conditions that tell less: one view of a camera image, a layout without
            outlines.
        views: number of views of a camera image.
        blank: (views, channels) features of a blank image, where the cache holds features of
            images, (N, 2, views, channels), as they are and mirrored, in place of pixels.
    """

    name: str
    dropout: float = 0.0
    reduction: float = 0.0
    views: int = 1
    blank: Tensor | None = None


@dataclass(frozen=True)
class Batches:
    """The endless sequence of training samples.

    Args:
        cache: the scans.
        tensors: layout of the network's tensors.
        seed: 0 <= seed < 2^62.
        flip: mirror every other sample, left to right; "both" = front to back too, by a mirror
            image that is turned round.
        roll: turn every sample about the vertical by a random whole number of columns, or by as
            many degrees at most, either way; of columns of the ``latents`` if there are any, by
            which an autoencoder whose columns wrap around turns them exactly.
        device: on which noise is generated and batches are assembled.
        codec: encodes tensors to states; None = the tensors are the states.
        latents: (N, 2, *codec.shape) encoded scans and mirrored scans (``cache_latents``), in place
            of ``codec``.
        conditioning: the field of the cache that is the condition; None = unconditional.
    """

    cache: ImageCache
    tensors: TensorFormat
    seed: int = 0
    flip: bool | str = False
    roll: bool | float = False
    device: torch.device | str = "cpu"
    codec: Codec | None = None
    conditioning: Conditioning | None = None
    latents: NDArray[np.float16] | None = None

    @property
    def turn(self) -> bool:
        """Whether samples are turned about the vertical."""
        return bool(self.roll) or self.flip == "both"

    def _turns(self, draws: Tensor, columns: int) -> list[int]:
        """How far each sample is turned, of ``columns``; ``draws`` (B, 5) are uniform."""
        if self.roll is True:
            turns = (draws[:, 2] * columns).long()
        else:
            most = columns * self.roll / 360
            turns = ((2 * draws[:, 2] - 1) * most).round().long()
        if self.flip == "both":  # of the mirrored and of the others, every other one
            turns += columns // 2 * (2 * draws[:, 1] % 1 < 0.5)
        return turns.tolist()

    def scans_at(self, positions: Sequence[int]) -> list[int]:
        """Index of the scan at each position; every epoch is a permutation of all scans."""
        count = len(self.cache)
        return [
            int(_permutation(self.seed, p // count, count)[p % count])
            for p in positions
        ]

    def __call__(self, positions: Sequence[int]) -> Batch:
        """The samples at these positions of the sequence."""
        seed = self.seed + _TRAINING
        draws = uniform(seed, positions, (5,))
        scans = self.scans_at(positions)
        mirrored = (draws[:, 1] < 0.5) & bool(self.flip)
        width = self.cache.sensor.columns
        unit = 1 if self.latents is None else width // self.latents.shape[-1]
        turns = self._turns(draws, width // unit)

        def augmented(x: Tensor) -> Tensor:
            x = _where(mirrored, x.flip(-1), x)
            return _rolled(x, [unit * n for n in turns]) if self.turn else x

        if self.latents is not None:
            held = torch.from_numpy(self.latents[scans, mirrored.long().numpy()])
            y0 = self._moved(held).float()
            y0 = _rolled(y0, turns) if self.turn else y0
        else:
            read = {n: self._moved(v) for n, v in self.cache.read(scans).items()}
            y0 = augmented(self.tensors.encode(read))
            y0 = y0 if self.codec is None else self.codec.encode(y0)
        about = self.conditioning
        if about is None:
            cond = None
        elif about.blank is None:
            cond = self._dropped(augmented(self._stored(scans)), draws)
        else:
            cond = self._dropped(self._stored(scans, mirrored), draws)
        return Batch(
            y0,
            gaussian(seed, positions, y0.shape[1:], self.device),
            self._moved(draws[:, 0]),
            cond,
        )

    def conditions(self, positions: Sequence[int]) -> Tensor | None:
        """The conditions (B, ...) of the scans at these positions, without dropout and
        augmentation; None if unconditional."""
        if self.conditioning is None:
            return None
        return self._stored(self.scans_at(positions))

    def _stored(self, scans: Sequence[int], mirrored: Tensor | None = None) -> Tensor:
        """The cached conditions (B, ...) of these scans; features of some mirrored images."""
        assert self.conditioning is not None
        field = self.cache.fields[CONDITIONS[self.conditioning.name].field]
        values = field[np.asarray(scans, np.int64)]
        if self.conditioning.blank is not None:
            sides = 0 if mirrored is None else mirrored.long().numpy()
            values = values[np.arange(len(values)), sides]
        return self._moved(torch.from_numpy(values))

    def _moved(self, values: Tensor) -> Tensor:
        """Values on the device; from pinned memory, the processor does not wait for a GPU."""
        if torch.device(self.device).type == "cuda":
            return values.pin_memory().to(self.device, non_blocking=True)
        return values.to(self.device)

    def _dropped(self, cond: Tensor, draws: Tensor) -> Tensor:
        """Conditions (B, ...) with dropout: some blank, some reduced."""
        assert self.conditioning is not None
        about = self.conditioning
        nothing = blank(about.name, cond)
        if about.blank is not None:
            nothing = about.blank.to(cond).expand_as(cond)
        if about.reduction:
            if about.blank is None:
                u = draws[:, 4] / about.reduction
                less = CONDITIONS[about.name].reduced(cond, u, about.views)
            else:
                less = nothing.clone()
                kept = about.views // 2  # as ``one_view`` of pixels
                less[:, kept] = cond[:, kept]
            cond = _where(draws[:, 4] < about.reduction, less, cond)
        if about.dropout:
            cond = _where(draws[:, 3] < about.dropout, nothing, cond)
        return cond


@dataclass(frozen=True)
class InTurns:
    """The samples of two sequences in turns: at even positions those of the first one.

    Raises:
        ConfigError: on samples with a condition.
    """

    first: Batches
    second: Batches

    def __post_init__(self) -> None:
        if self.first.conditioning is not None:
            raise ConfigError(
                f"rehearsal for a model with the condition {self.first.conditioning.name!r}",
                "none",
            )

    @property
    def tensors(self) -> TensorFormat:
        """Layout of the network's tensors."""
        return self.first.tensors

    def __call__(self, positions: Sequence[int]) -> Batch:
        """The samples at these positions."""
        parts = [(self.first, self.second)[p % 2]([p // 2]) for p in positions]
        y0, y1, u, _ = zip(*parts, strict=True)
        return Batch(torch.cat(y0), torch.cat(y1), torch.cat(u))


def _where(chosen: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Per sample, a where ``chosen`` (B,) is true, else b; both (B, ...)."""
    ones = [1] * (b.ndim - 1)
    return torch.where(chosen.to(b.device).view(-1, *ones), a, b)


def _rolled(x: Tensor, columns: Sequence[int]) -> Tensor:
    """Each sample of (B, ..., W) rolled by its own number of columns."""
    return torch.stack([one.roll(c, -1) for one, c in zip(x, columns, strict=True)])


@lru_cache(maxsize=2)
def _permutation(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    """(count,) a permutation, a function of the seed and the epoch."""
    # One number per scan and epoch, at indices that positions (< 2^62) do not use.
    keys = uniform(
        seed + _TRAINING,
        range((1 << 62) + epoch * count, (1 << 62) + (epoch + 1) * count),
    )
    return np.argsort(keys.numpy(), kind="stable")


def micro_batches(
    step: int,
    batch: int,
    accumulate: int,
    process: int = 0,
    processes: int = 1,
) -> list[range]:
    """The positions that one process trains on in one optimiser step, one range per micro-batch.

    Args:
        step: number of the step, from 0.
        batch: samples of a step, over all micro-batches and processes.
        accumulate: micro-batches of a step.
        process, processes: index of this process, number of processes.

    Raises:
        ConfigError: if the batch cannot be divided.
    """
    parts = accumulate * processes
    size = batch // parts
    if batch % parts:
        raise ConfigError(
            f"recipe.batch={batch} with recipe.accumulate={accumulate} in {processes} processes",
            f"a multiple of {parts}, such as recipe.batch={(size + 1) * parts}",
        )
    numbers = range(step * accumulate, (step + 1) * accumulate)
    places = (number * processes + process for number in numbers)
    return [range(place * size, (place + 1) * size) for place in places]
