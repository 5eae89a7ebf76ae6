"""Training data: scans kept as compact range images, and batches that are a function of their position alone.

A run asks for samples by their position in one endless sequence. What stands there (which scan, turned and mirrored
how, with which noise, at which time) follows from (seed, position) and nothing else, so that a run that was killed,
or that runs on another number of processes, sees the same data.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files import write_file
from lidar_synth.noise import gaussian, uniform
from lidar_synth.normalize import TensorFormat
from lidar_synth.projection import project
from lidar_synth.scan import RangeImage, Source
from lidar_synth.sensor import Sensor

DTYPES = {"range": np.uint16, "reflectance": np.uint8, "label": np.uint8}
"""How a cache holds each channel: the range in 65535 steps of the sensor's farthest (1.2 mm for 80 m), reflectance
in 255, labels as they are."""

_TRAINING = 1 << 62
"""Added to a run's seed, so that its noise is not that of the scans that are made with the same seed."""

_SAVE_EVERY = 64  # scans between two notes of how far a cache has come


@dataclass(frozen=True)
class ImageCache:
    """Range images, 3 to 4 bytes a cell.

    Args:
        fields: {channel: (N, H, W)} of the types in ``DTYPES``, in memory or memory-mapped.
        sensor: whose grid.
    """

    fields: Mapping[str, NDArray[Any]]
    sensor: Sensor

    def __len__(self) -> int:
        return len(self.fields["range"])

    def read(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """(B, H, W) of each channel: range float32 metres, reflectance float32 in [0, 1], label uint8."""
        values = {name: torch.from_numpy(v[np.asarray(indices, np.int64)]) for name, v in self.fields.items()}
        values["range"] = values["range"].float() * (self.sensor.range_max / 65535)
        if "reflectance" in values:
            values["reflectance"] = values["reflectance"].float() / 255
        return values

    def write(self, index: int, image: RangeImage) -> None:
        """Put a range image into its place."""
        self.fields["range"][index] = np.rint(image.range * (65535 / self.sensor.range_max)).clip(max=65535)
        if "reflectance" in self.fields:
            self.fields["reflectance"][index] = np.rint(image.channels["reflectance"].clip(0, 1) * 255)
        if "label" in self.fields:
            self.fields["label"][index] = image.channels["label"]


def cache_scans(
    source: Source,
    sensor: Sensor,
    channels: Iterable[str],
    folder: Path | None = None,
    description: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> ImageCache:
    """The scans of a source, projected once.

    Args:
        source: of scans.
        sensor: whose grid.
        channels: names of ``DTYPES``.
        folder: keep the cache there, memory-mapped: a second call finds it, an interrupted one goes on; by
            default the cache is in memory.
        description: what tells this source from another one, plain values; stands beside the cache.
        progress: show a bar.

    Raises:
        ConfigError: where ``folder`` holds the cache of something else, or a scan lacks a channel.
        DataError: where the source is empty.
        FileError: where the folder cannot be written.
    """
    if not len(source):
        raise DataError("a source without scans", "at least one")
    shape = (len(source), *sensor.shape)
    names = [name for name in DTYPES if name in set(channels)]
    if folder is None:
        cache, done = ImageCache({n: np.empty(shape, DTYPES[n]) for n in names}, sensor), 0
    else:
        facts = {"sensor": sensor.to_dict(), "shape": shape, "channels": names, "source": dict(description or {})}
        cache, done = _open_folder(folder, facts, sensor)
    for i in tqdm(range(done, len(source)), desc="scans", disable=not progress or done == len(source)):
        cache.write(i, project(source[i], sensor, [n for n in names if n != "range"]))
        if folder is not None and ((i + 1) % _SAVE_EVERY == 0 or i + 1 == len(source)):
            for values in cache.fields.values():
                values.flush()  # type: ignore[attr-defined]  # a memmap
            _note(folder, facts, i + 1)
    return cache


def _open_folder(folder: Path, facts: dict[str, Any], sensor: Sensor) -> tuple[ImageCache, int]:
    """A cache on disk and the number of scans that are in it."""
    note = folder / "cache.json"
    try:
        if note.exists():
            found = json.loads(note.read_text())
            done = found.pop("done")
            if found != json.loads(json.dumps(facts)):
                differs = [key for key in facts if found.get(key) != json.loads(json.dumps(facts[key]))]
                raise ConfigError(f"{folder} is the cache of other data ({', '.join(differs)} differ)",
                                  "the cache of this configuration", "Remove it, or name another folder.")  # fmt: skip
            mode: Literal["r", "r+"] = "r" if done == facts["shape"][0] else "r+"
            maps = {n: np.load(folder / f"{n}.npy", mmap_mode=mode) for n in facts["channels"]}
            return ImageCache(maps, sensor), done
        folder.mkdir(parents=True, exist_ok=True)
        shape = facts["shape"]
        new = {n: np.lib.format.open_memmap(folder / f"{n}.npy", "w+", DTYPES[n], shape) for n in facts["channels"]}
        return ImageCache(new, sensor), 0
    except (OSError, KeyError, json.JSONDecodeError) as error:
        raise FileError(f"the cache {folder} cannot be opened ({error})", "a folder that can be written") from error


def _note(folder: Path, facts: dict[str, Any], done: int) -> None:
    write_file(folder / "cache.json", json.dumps(facts | {"done": done}, indent=1).encode())


class Batch(NamedTuple):
    """What a task makes an example of.

    Args:
        y0: (B, C, H, W) data in [-1, 1].
        y1: (B, C, H, W) standard normal noise.
        u: (B,) uniform numbers in (0, 1), for the time.
    """

    y0: Tensor
    y1: Tensor
    u: Tensor


@dataclass(frozen=True)
class Batches:
    """The endless sequence of training samples.

    Args:
        cache: of the scans.
        tensors: their layout for the network.
        seed: 0 <= seed < 2^62.
        flip: mirror every other sample, left to right.
        roll: turn every sample about the vertical by a random whole number of columns.
        device: where the noise is made and the tensors are put together.
    """

    cache: ImageCache
    tensors: TensorFormat
    seed: int = 0
    flip: bool = False
    roll: bool = False
    device: torch.device | str = "cpu"

    def scans_at(self, positions: Sequence[int]) -> list[int]:
        """Which scan stands at each position: every epoch is a permutation of all."""
        count = len(self.cache)
        return [int(_permutation(self.seed, p // count, count)[p % count]) for p in positions]

    def __call__(self, positions: Sequence[int]) -> Batch:
        """The samples at these positions of the sequence."""
        seed = self.seed + _TRAINING
        chance = uniform(seed, positions, (3,))
        fields = {n: v.to(self.device) for n, v in self.cache.read(self.scans_at(positions)).items()}
        y0 = self.tensors.encode(fields)
        if self.flip:
            mirrored = (chance[:, 1] < 0.5).to(y0.device)
            y0 = torch.where(mirrored[:, None, None, None], y0.flip(-1), y0)
        if self.roll:
            columns = (chance[:, 2] * y0.shape[-1]).long().tolist()
            y0 = torch.stack([y.roll(c, -1) for y, c in zip(y0, columns, strict=True)])
        return Batch(y0, gaussian(seed, positions, y0.shape[1:], self.device), chance[:, 0].to(self.device))


@lru_cache(maxsize=2)
def _permutation(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    """(count,) an order that follows from the seed and the epoch."""
    # One number per scan and epoch, well away from the positions' own (index < 2^62).
    keys = uniform(seed + _TRAINING, range((1 << 62) + epoch * count, (1 << 62) + (epoch + 1) * count))
    return np.argsort(keys.numpy(), kind="stable")


def micro_batches(step: int, batch: int, accumulate: int, process: int = 0, processes: int = 1) -> Iterator[range]:
    """The positions that one process takes in one optimiser step, micro-batch by micro-batch.

    Args:
        step: number of the step, from 0.
        batch: samples of a step, over all micro-batches and processes.
        accumulate: micro-batches of a step.
        process, processes: which of how many.

    Raises:
        ConfigError: where the batch cannot be divided.
    """
    if batch % (accumulate * processes):
        raise ConfigError(f"batch {batch} over {accumulate} micro-batches and {processes} processes", "a multiple")
    size = batch // (accumulate * processes)
    for i in range(accumulate):
        start = step * batch + (i * processes + process) * size
        yield range(start, start + size)
