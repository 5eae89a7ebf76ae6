"""Training data on disk: scans kept as compact range images, projected once, with checksums."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.bank.encoding import LEVELS, TYPES, Encoding
from lidar_synth.errors import DataError
from lidar_synth.files.disk import hash_of_names
from lidar_synth.formats import BankScans, RangePNG, ScanFiles
from lidar_synth.generate.codec import Codec
from lidar_synth.geometry import Scan, Sensor, Source
from lidar_synth.geometry.normalize import TensorFormat
from lidar_synth.geometry.projection import project
from lidar_synth.lab.train.arrays import FILES, Arrays, Layout, make_arrays
from lidar_synth.lab.train.ranks import ALONE, Ranks

DTYPES: dict[str, type[np.generic]] = {
    name: TYPES[name] for name in ("range", "reflectance", "label")
}
"""Data type of each channel in a cache, the same as in a bank."""

CAMERA_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class ImageCache:
    """Range images, 3 to 4 bytes a cell.

    Args:
        fields: {channel: (N, H, W)} of the types in ``DTYPES``, in memory or memory-mapped; others,
            such as camera images (N, 3, h, w), are uint8 and stay as they are.
        sensor: defines the grid.
    """

    fields: Mapping[str, NDArray[Any]]
    sensor: Sensor

    @cached_property
    def encoding(self) -> Encoding:
        """The encoding of the channels."""
        return Encoding(self.sensor, DTYPES.keys() & self.fields.keys())

    def __len__(self) -> int:
        return len(self.fields["range"])

    def read(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """(B, H, W) of each channel: range float32 metres, reflectance float32 in [0, 1], label
        uint8; (B, ...) uint8 of all else."""
        values = {
            name: torch.from_numpy(v[np.asarray(indices, np.int64)])
            for name, v in self.fields.items()
        }
        values["range"] = values["range"].float() * self.encoding.scale
        if "reflectance" in values:
            values["reflectance"] = (
                values["reflectance"].float() / LEVELS["reflectance"]
            )
        return values


class Other(NamedTuple):
    """What a cache keeps of every scan beside its range image.

    Args:
        shape: of one scan.
        read: the number of a scan in its source, and the scan, to values of this shape.
        dtype: of the values.
        maker: hash of the network that makes them, if one does.
    """

    shape: tuple[int, ...]
    read: Callable[[int, Scan], NDArray[Any]]
    dtype: type[np.generic] = np.uint8
    maker: str | None = None

    @property
    def facts(self) -> list[Any]:
        """What tells it from others."""
        return [*self.shape, self.maker] if self.maker else [*self.shape]


def cache_scans(
    source: Source,
    sensor: Sensor,
    channels: Iterable[str],
    folder: Path | None = None,
    description: Mapping[str, Any] | None = None,
    progress: bool = True,
    others: Mapping[str, Other] | None = None,
    ranks: Ranks = ALONE,
    jobs: int = 1,
) -> ImageCache:
    """The scans of a source, projected once.

    Args:
        source: of scans.
        sensor: defines the grid.
        channels: names of ``DTYPES``.
        folder: keep the cache there, memory-mapped: a second call finds it, an interrupted one goes
            on, unless a file of the source has changed; by default the cache is in memory.
        description: what tells this source from another one, plain values; stands beside the cache.
        progress: show a bar.
        others: {name: what else to keep}.
        ranks: the processes that share the work, each of which calls this with the same arguments.
        jobs: processes that work for the only one of ``ranks`` and keep the scans in a ``folder``;
            scans with ``others`` are made by one.

    Raises:
        ConfigError: where ``folder`` holds the cache of something else, or a scan lacks a channel.
        DataError: where the source is empty, or a scan lacks one of ``others``.
        FileError: where the folder cannot be written.
    """
    if not len(source):
        raise DataError("a source without scans", "at least one")
    others = others or {}
    shape = (len(source), *sensor.shape)
    names = [name for name in DTYPES if name in set(channels)]
    layout: Layout = {name: (shape, DTYPES[name]) for name in names} | {
        name: ((len(source), *other.shape), other.dtype)
        for name, other in others.items()
    }
    facts = {
        "sensor": sensor.to_dict(),
        "shape": shape,
        "channels": names,
        "source": dict(description or {}),
    }
    if others:
        facts["others"] = {name: other.facts for name, other in others.items()}
    if folder is not None and (
        files := _hash_of_files(source, folder, {*names, *others})
    ):
        facts[FILES] = files

    make = _Project(source, sensor, tuple(names), others)
    spread = 1 if others else jobs
    return ImageCache(
        make_arrays(layout, make, "scans", folder, facts, ranks, progress, spread),
        sensor,
    )


def _hash_of_files(source: Any, cache: Path, fields: Set[str]) -> str | None:
    """A hash of the ids of a source, and of the names, sizes and modification times of the files of
    these fields, or of several sources; None for scans that are no files, such as the town's.

    Camera images count only where ``fields`` has a condition: a dataset may get them later.
    """
    told: list[str] = []
    for part in getattr(source, "datasets", [source]):
        if isinstance(part, ScanFiles):
            plain = fields <= DTYPES.keys() and not isinstance(part, RangePNG)
            told += part.ids
            if isinstance(part, BankScans):  # may be at a URL
                told.append(part.bank.identity)
                continue
            for place in part.files_for(fields):
                told += _tell_files(place, cache, CAMERA_SUFFIXES if plain else ())
    return hash_of_names(told) if told else None


def _tell_files(root: Path, cache: Path, skipped: tuple[str, ...]) -> Iterator[str]:
    """Name, size and modification time of each file below a folder; or of the file."""
    # A run that lies among its scans writes beside its cache.
    own = {cache.resolve(), cache.parent.resolve()}
    paths = [root]
    for folder, names, files in os.walk(root, followlinks=True):
        names[:] = [n for n in names if Path(folder, n).resolve() not in own]
        kept = (name for name in files if name[0] != "." and not name.endswith(skipped))
        paths += [Path(folder, name) for name in kept]
    for path in sorted(paths):
        if path.is_file():
            found = path.stat()
            name = path.relative_to(root).as_posix()
            yield f"{name} {found.st_size} {int(found.st_mtime)}"


@dataclass(frozen=True)
class _Project:
    """Makes what a cache keeps of a scan."""

    source: Source
    sensor: Sensor
    channels: tuple[str, ...]
    others: Mapping[str, Other]

    def __call__(self, i: int) -> Arrays:
        scan = self.source[i]
        carried = [name for name in self.channels if name != "range"]
        image = project(scan, self.sensor, carried)
        kept = {name: other.read(i, scan) for name, other in self.others.items()}
        return Encoding(self.sensor, self.channels).encode(image) | kept


def cache_latents(
    cache: ImageCache,
    tensors: TensorFormat,
    codec: Codec,
    device: torch.device | str,
    folder: Path | None = None,
    codec_hash: str = "",
    progress: bool = True,
    ranks: Ranks = ALONE,
) -> NDArray[np.float16]:
    """The latents of all scans of a cache, as they are and mirrored: an autoencoder that stands
    still need not look at the same scan in every epoch.

    Args:
        cache: of N scans.
        tensors: layout of the codec's tensors.
        codec: of the latents.
        device: where it is.
        folder: keep them in a folder of their own below it; a second call with the same
            ``codec_hash`` finds them. By default in memory.
        codec_hash: of the weights that encode.
        progress: show a bar.
        ranks: as for ``cache_scans``.

    Returns:
        (N, 2, *codec.shape) float16; the second of each scan is that of the mirrored one.

    Raises:
        FileError: where the folder cannot be written.
    """
    layout: Layout = {"latents": ((len(cache), 2, *codec.shape), np.float16)}
    place = None if folder is None else folder / f"latents-{codec_hash[:16]}"

    def make(i: int) -> Arrays:
        x = tensors.encode({n: v.to(device) for n, v in cache.read([i]).items()})
        made = codec.encode(torch.cat([x, x.flip(-1)]))
        return {"latents": made.float().cpu().numpy().astype(np.float16)}

    facts = {"codec": codec_hash}
    arrays = make_arrays(layout, make, "latents", place, facts, ranks, progress)
    return arrays["latents"]
