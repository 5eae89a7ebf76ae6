"""Features kept on disk, by the hash of the scan and of the extractor's weights, and extracted by
several processes.

A folder holds one file per scan and extractor. Files are written whole or not at all, so that
processes may share a folder; a file that cannot be read is made again.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lidar_synth.errors import DataError, FileError
from lidar_synth.files.disk import sha256, write_arrays
from lidar_synth.files.parsing import read_arrays
from lidar_synth.files.processes import map_in_processes
from lidar_synth.geometry import Scan, Source, scan_hash

VERSION = 1
"""Of the extractors' arithmetic; a change of it makes all features anew."""


def checked(
    extract: Callable[..., NDArray[np.floating]], scans: Sequence[Scan], *more: bool
) -> NDArray[np.floating]:
    """Features (n, D) of n scans.

    Raises:
        DataError: where an extractor returns another shape, or features that are not finite.
    """
    features = np.asarray(extract(scans, *more))
    if features.ndim != 2 or len(features) != len(scans):
        raise DataError(
            f"features of shape {features.shape} of {len(scans)} scans",
            f"({len(scans)}, D)",
        )
    finite = np.isfinite(features).all(1)
    if not finite.all():
        raise DataError(
            f"scan {scans[int(finite.argmin())].id!r}: features that are not finite",
            "finite numbers",
        )
    return features


def weights_hash(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of all files in a folder.

    Raises:
        FileError: if a file cannot be read.
    """
    if path.is_file():
        return sha256(path)
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()):
        digest.update(f"{file.relative_to(path).as_posix()} {sha256(file)} ".encode())
    return digest.hexdigest()


@dataclass(frozen=True)
class Cached:
    """An extractor that keeps its features; itself an ``Extractor``.

    Args:
        extract: makes the features of scans; takes the further arguments of the call, too.
        folder: for the files; several extractors may share it.
        key: what the features depend on beside the scan: the extractor's name, ``weights_hash``,
            its preparation.
    """

    extract: Callable[..., NDArray[np.floating]]
    folder: Path
    key: str

    def __call__(self, scans: Sequence[Scan], *more: bool) -> NDArray[np.floating]:
        """(n, D) features of n scans; only of those that are not kept the features are made.

        Raises:
            DataError: on features of another shape, or that are not finite.
            FileError: where a file cannot be written.
        """
        paths = [self._path(scan, more) for scan in scans]
        found = [_read(path) for path in paths]
        new = [i for i, features in enumerate(found) if features is None]
        if new:
            for i, features in zip(
                new, checked(self.extract, [scans[i] for i in new], *more), strict=True
            ):
                write_arrays(paths[i], {"features": features})
                found[i] = features
        return np.stack([features for features in found if features is not None])

    def _path(self, scan: Scan, more: tuple[bool, ...]) -> Path:
        name = hashlib.sha256(
            f"{VERSION} {self.key} {more} {scan_hash(scan)}".encode()
        ).hexdigest()
        return self.folder / name[:2] / f"{name}.npz"


def _read(path: Path) -> NDArray[np.floating] | None:
    if not path.is_file():
        return None
    try:
        features: NDArray[np.floating] = read_arrays(path)["features"]
    except (DataError, FileError, KeyError):
        return None
    return features if features.ndim == 1 and np.isfinite(features).all() else None


def extract_all(
    make: Callable[[], Callable[..., NDArray[np.floating]]],
    source: Source,
    processes: int = 1,
    batch: int = 16,
    more: tuple[bool, ...] = (),
) -> NDArray[np.floating]:
    """(N, D) features of all scans of a source, by several processes that each make an extractor of
    their own.

    At most ``batch`` scans of each process are in memory.

    Args:
        make: makes the extractor, for instance one that is ``Cached``; a function at the top level
            of a module, or a partial of one.
        source: the scans; it is sent to the processes.
        processes: number of them; 1 = this one.
        batch: number of scans that an extractor gets at a time.
        more: further arguments of the extractor.

    Raises:
        DataError: on an empty source, and as the extractor.
        ProcessError: as ``map_in_processes``.
    """
    parts = [
        range(i, min(i + batch, len(source))) for i in range(0, len(source), batch)
    ]
    if not parts:
        raise DataError("no scans", "at least one")
    processes = min(processes, len(parts))
    threads = max(1, torch.get_num_threads() // processes)
    work = _Extraction(make, source, more, threads)
    with map_in_processes(work, parts, processes) as features:
        return np.concatenate(list(features))


@dataclass(frozen=True)
class _Extraction:
    """The features of a part of a source, by an extractor that each process makes once."""

    make: Callable[[], Callable[..., NDArray[np.floating]]]
    source: Source
    more: tuple[bool, ...]
    threads: int

    @cached_property
    def _extract(self) -> Callable[..., NDArray[np.floating]]:
        torch.set_num_threads(self.threads)
        return self.make()

    def __call__(self, part: range) -> NDArray[np.floating]:
        scans = [self.source[i] for i in part]
        return checked(self._extract, scans, *self.more)
