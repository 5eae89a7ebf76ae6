"""Training data on disk: scans kept as compact range images, projected once, with checksums."""

import json
import warnings
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lidar_synth.bank.encoding import LEVELS, TYPES, Encoding
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.files.disk import unreadable, write_file
from lidar_synth.files.parsing import read_sealed, seal
from lidar_synth.generate.codec import Codec
from lidar_synth.geometry.normalize import TensorFormat
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import RangeImage, Scan, Source
from lidar_synth.geometry.sensor import Sensor

DTYPES: dict[str, type[np.generic]] = {
    name: TYPES[name] for name in ("range", "reflectance", "label")
}
"""Data type of each channel in a cache, the same as in a bank."""

Layout = dict[str, tuple[tuple[int, ...], type[np.generic]]]
"""{field of a cache: its shape and type}."""

BLOCK = 64
"""Scans of a cache that share a checksum: they are noted when they are complete, and made again if
they are damaged."""

NOTE = "cache.json"
"""The file beside a cache that says what it holds, with the checksums of its blocks."""


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

    def write(
        self,
        index: int,
        image: RangeImage,
        others: Mapping[str, NDArray[np.uint8]] | None = None,
    ) -> None:
        """Put a range image, and what else is kept of its scan, into its place.

        Raises:
            DataError: on a value that has no code, see ``Encoding.encode``.
        """
        self.encoding.encode(
            image, {name: self.fields[name][index] for name in self.encoding.names}
        )
        for name, values in (others or {}).items():
            self.fields[name][index] = values


class Other(NamedTuple):
    """What a cache keeps of every scan beside its range image.

    Args:
        shape: of one scan.
        read: the number of a scan in its source, and the scan, to uint8 values of this shape.
    """

    shape: tuple[int, ...]
    read: Callable[[int, Scan], NDArray[np.uint8]]


def cache_scans(
    source: Source,
    sensor: Sensor,
    channels: Iterable[str],
    folder: Path | None = None,
    description: Mapping[str, Any] | None = None,
    progress: bool = True,
    others: Mapping[str, Other] | None = None,
) -> ImageCache:
    """The scans of a source, projected once.

    Args:
        source: of scans.
        sensor: defines the grid.
        channels: names of ``DTYPES``.
        folder: keep the cache there, memory-mapped: a second call finds it, an interrupted one goes
            on; by default the cache is in memory.
        description: what tells this source from another one, plain values; stands beside the cache.
        progress: show a bar.
        others: {name: what else to keep}.

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
    layout: Layout = {name: (shape, DTYPES[name]) for name in names}
    layout |= {
        name: ((len(source), *other.shape), np.uint8) for name, other in others.items()
    }
    if folder is None:
        cache = ImageCache({n: np.empty(*kind) for n, kind in layout.items()}, sensor)
        sums: list[int | None] = [None] * -(-len(source) // BLOCK)
    else:
        facts = {
            "sensor": sensor.to_dict(),
            "shape": shape,
            "channels": names,
            "source": dict(description or {}),
        }
        if others:
            facts["others"] = {name: other.shape for name, other in others.items()}
        cache, sums = _open_folder(folder, facts, layout, sensor)
    missing = [block for block, found in enumerate(sums) if found is None]
    for block in tqdm(
        missing, desc="scans", unit_scale=BLOCK, disable=not progress or not missing
    ):
        for i in range(len(source))[_span(block)]:
            scan = source[i]
            image = project(scan, sensor, [n for n in names if n != "range"])
            cache.write(
                i, image, {name: other.read(i, scan) for name, other in others.items()}
            )
        if folder is not None:
            for values in cache.fields.values():
                values.flush()  # type: ignore[attr-defined]  # a memmap
            sums[block] = _sum(cache.fields, block)
            _note(folder, facts, sums)
    return cache


def cache_latents(
    cache: ImageCache,
    tensors: TensorFormat,
    codec: Codec,
    device: torch.device | str,
    folder: Path | None = None,
    codec_hash: str = "",
    progress: bool = True,
) -> NDArray[np.float16]:
    """The latents of all scans of a cache, as they are and mirrored: an autoencoder that stands
    still need not look at the same scan in every epoch.

    Args:
        cache: of N scans.
        tensors: layout of the codec's tensors.
        codec: of the latents.
        device: where it is.
        folder: keep them there; a second call with the same ``codec_hash`` finds them. By default
            in memory.
        codec_hash: of the codec's weights.
        progress: show a bar.

    Returns:
        (2, N, *codec.shape) float16; the second half is of the mirrored scans.

    Raises:
        FileError: where the folder cannot be written.
    """
    shape = (2, len(cache), *codec.shape)
    path = None if folder is None else folder / f"latents-{codec_hash[:16]}.npy"
    if path is not None and path.exists():
        try:
            found: NDArray[np.float16] = _open_array(path, "r", shape, np.float16)
            if read_sealed(path.with_suffix(".json"), "the sum of latents")[
                "sum"
            ] == zlib.crc32(found.data):
                return found
            raise DataError(f"{path} is damaged")
        except (DataError, FileError, KeyError) as error:
            warnings.warn(f"{error}; the latents are made again", stacklevel=2)
    latents = np.empty(shape, np.float16)
    for i in tqdm(range(len(cache)), desc="latents", disable=not progress):
        x = tensors.encode(cache.read([i])).to(device)
        latents[:, i] = codec.encode(torch.cat([x, x.flip(-1)])).float().cpu().numpy()
    if path is not None:
        write_file(path, lambda file: np.save(file, latents))
        write_file(path.with_suffix(".json"), seal({"sum": zlib.crc32(latents.data)}))
    return latents


def _open_folder(
    folder: Path, facts: dict[str, Any], layout: Layout, sensor: Sensor
) -> tuple[ImageCache, list[int | None]]:
    """A cache on disk, and the sum of each block of scans; None where the block is to be made."""
    sums: list[int | None] = [None] * -(-facts["shape"][0] // BLOCK)
    if (folder / NOTE).exists():
        try:
            sums = _check(folder, facts, layout)
        except DataError as error:
            warnings.warn(f"{error}; the cache is made again", stacklevel=2)
    try:
        maps = {
            n: _open_array(
                folder / f"{n}.npy", "r+" if None in sums else "r", *layout[n]
            )
            for n in layout
        }
        return ImageCache(maps, sensor), sums
    except (DataError, FileError):
        pass  # a new cache, or a damaged one
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (
            layout
        ):  # another run may read the old files, which must not shrink under it
            (folder / f"{name}.npy").unlink(missing_ok=True)
        new = {
            n: np.lib.format.open_memmap(folder / f"{n}.npy", "w+", d, s)
            for n, (s, d) in layout.items()
        }
    except OSError as error:
        raise FileError(
            f"the cache {folder} cannot be opened ({error})",
            "a folder that can be written",
        ) from error
    sums = [None] * len(sums)
    _note(
        folder, facts, sums
    )  # another run that opens the folder now does not empty the files
    return ImageCache(new, sensor), sums


def _check(folder: Path, facts: dict[str, Any], layout: Layout) -> list[int | None]:
    """The sums of the blocks of a cache that are complete and intact.

    Raises:
        ConfigError: if it is the cache of other data.
        DataError: if its files are damaged as a whole.
    """
    found = read_sealed(folder / NOTE, "the notes of a cache")
    wanted = json.loads(json.dumps(facts))
    sums = found.pop("sums", None)
    if found != wanted:
        differs = [key for key in found | wanted if found.get(key) != wanted.get(key)]
        raise ConfigError(
            f"{folder} is the cache of other data ({', '.join(differs)} differ)",
            "the cache of this configuration",
            "Remove it, or name another folder.",
        )
    if not isinstance(sums, list):
        raise DataError(f"{folder / NOTE} is damaged", "the sums of a cache")
    maps = {n: _open_array(folder / f"{n}.npy", "r", *layout[n]) for n in layout}
    intact = [
        s if s is None or s == _sum(maps, block) else None
        for block, s in enumerate(sums)
    ]
    if damaged := [
        block for block, s in enumerate(sums) if s is not None and intact[block] is None
    ]:
        named = ", ".join(
            f"{_span(block).start} to {_span(block).stop - 1}" for block in damaged[:5]
        )
        more = f" and {len(damaged) - 5} more blocks" if len(damaged) > 5 else ""
        warnings.warn(
            f"{folder}: scans {named}{more} are damaged, and are made again",
            stacklevel=2,
        )
    return intact


def _open_array(
    path: Path,
    mode: Literal["r", "r+"],
    shape: tuple[int, ...],
    dtype: type[np.generic],
) -> NDArray[Any]:
    """Map an ``.npy`` file of this shape and type into memory; its header has to be the one that
    numpy writes.

    Raises:
        DataError: on another file.
        FileError: if it cannot be read.
    """
    header = BytesIO()
    np.lib.format.write_array_header_1_0(
        header,
        {
            "descr": np.lib.format.dtype_to_descr(np.dtype(dtype)),
            "fortran_order": False,
            "shape": shape,
        },
    )
    start = header.getvalue()
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            same = file.read(len(start)) == start
        if not same or size != len(start) + prod(shape) * np.dtype(dtype).itemsize:
            raise DataError(
                f"{path} is truncated or damaged", f"{np.dtype(dtype)} of shape {shape}"
            )
        return np.memmap(path, dtype, mode, len(start), shape)
    except OSError as error:
        raise unreadable(path, error, "a file of a cache") from error


def _span(block: int) -> slice:
    return slice(block * BLOCK, (block + 1) * BLOCK)


def _sum(fields: Mapping[str, NDArray[Any]], block: int) -> int:
    """A CRC-32 over the scans of a block, field by field."""
    total = 0
    for name in sorted(fields):
        total = zlib.crc32(np.ascontiguousarray(fields[name][_span(block)]).data, total)
    return total


def _note(folder: Path, facts: dict[str, Any], sums: list[int | None]) -> None:
    write_file(folder / NOTE, seal(facts | {"sums": sums}))
