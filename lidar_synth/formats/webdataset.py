"""WebDataset: scans in tar files for sequential reading (https://github.com/webdataset/webdataset).

The members of a scan are stored consecutively; their names begin with its key, the scan's id with
dots and % encoded as %2E and %25::

    scans-000000.tar          the first 1000 scans, and so on
      KEY.json                id, domain (0 real, 1 synthetic), sensor (the keys of sensors.yaml);
                              if known also provenance, pose (4 x 4, sensor to world), names of the
                              boxes, and under "boxes" the other fields of ``Boxes``
      KEY.points.npy          (N, 4) float32: x, y, z in metres, reflectance in [0, 1]
      KEY.label.npy           (N,) uint8 train ids, 255 = ignore; always written, so that samples
                              have the same keys, with "labelled": false in KEY.json if the scan has
                              no labels
      KEY.confidence.npy      and other known fields per point: raw_label, instance, ring
      KEY.boxes.npy           (M, 7) float32, if there are boxes: x, y, z, l, w, h, yaw

WebDataset's own ``decode()`` converts them to arrays and a dictionary. The same scans give the same
bytes.
"""

import json
import os
import tarfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader, BytesIO, FileIO
from itertools import groupby
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote

import numpy as np

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.errors import DataError, LidarSynthError, check_count, parsing, shorten
from lidar_synth.files.disk import (
    SKIP_HINT,
    list_files,
    open_file,
    write_file,
)
from lidar_synth.files.parsing import TarMember, parse_json, parse_npy
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.folder import boxes_as_lists, boxes_from_lists
from lidar_synth.formats.npz import decode_scan
from lidar_synth.formats.points import check_scan
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.formats.writer import DETAILS, NOTES, FileWriter, clear_notes
from lidar_synth.geometry import Scan, Sensor

SUFFIX = ".tar"

Members = dict[str, tuple[int, int]]
"""The members of a scan in their tar file: {name after the key: (offset, size in bytes)}."""


class WebDataset(ScanFiles):
    """A folder of WebDataset's .tar files as the package writes them, or one such file.

    Args:
        root: the folder or the file.
        sensor: takes precedence over the sensor that the files name.
        on_bad: see ``ScanFiles``; a tar file whose headers are damaged always raises an error.

    Raises:
        FileError: if the path does not exist.
        DataError: if there is no scan, or a file is not a tar file.
    """

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        return root.suffix == SUFFIX or any(root.glob(f"*{SUFFIX}"))

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        root = Path(root)
        paths = [root] if root.is_file() else list_files(root, SUFFIX)
        self._places = [(path, *place) for path in paths for place in _scans(path)]
        stored = None
        with suppress(DataError):  # reading the scan will raise it
            stored = _decode(*self._places[0], None).sensor if self._places else None
        super().__init__(
            root,
            [unquote(key) for _, key, _ in self._places],
            sensor,
            on_bad,
            stored=stored,
        )

    def read(self, index: int) -> Scan:
        return _decode(*self._places[index], self._given)


class WebDatasetWriter(FileWriter):
    """Writes WebDataset's .tar files. Each scan is written to a file of its own; ``finish`` merges
    them in order.

    Scans that a later run adds, because they could not be read before, are appended to their file,
    and so are those that are written again, in place of the old ones.

    Args:
        root: output folder.
        shard_size: number of scans in a file.
        calibration: not used; the format stores neither calibration nor images.

    Raises:
        ConfigError: on fewer than one scan in a file.
    """

    keeps = frozenset(DETAILS) - {"image_path"}

    def __init__(
        self,
        root: str | Path,
        *,
        shard_size: int = 1000,
        calibration: Calibration | None = None,
    ) -> None:
        super().__init__(root, calibration=calibration)
        check_count("shard_size", shard_size, 1)
        self.shard_size = shard_size
        self._there: set[str] | None = None

    @property
    def _base(self) -> Path:
        return self.root / NOTES

    def _place(self, index: int, name: str | None) -> str:
        return f"{index:09d}/{_key(index, name)}{SUFFIX}"

    def complete(self, index: int, name: str | None = None) -> bool:
        if self._there is None:
            self._there = {
                key for path in self.root.glob(f"*{SUFFIX}") for key, _ in _scans(path)
            }
        return _key(index, name) in self._there or super().complete(index, name)

    def _write_file(self, path: Path, scan: Scan) -> None:
        write_file(
            path, lambda file: _write_tar(file, _encode(self._key_of(path), scan))
        )

    def _key_of(self, path: Path) -> str:
        """The key of the scan in a file that is still to be merged."""
        return (
            Path(*path.relative_to(self.root / NOTES).parts[1:])
            .with_suffix("")
            .as_posix()
        )

    def finish(self) -> None:
        parts: dict[int, list[Path]] = defaultdict(list)
        for path in sorted((self.root / NOTES).rglob(f"*{SUFFIX}")):
            number = int(path.relative_to(self.root / NOTES).parts[0])
            parts[number // self.shard_size].append(path)
        for number, paths in parts.items():
            shard = self.root / f"scans-{number:06d}{SUFFIX}"
            members = _merge(shard, {self._key_of(path): path for path in paths})
            write_file(
                shard,
                lambda file, members=members: _write_tar(file, members),  # type: ignore[misc]
            )
        clear_notes(self.root)
        self._there = None


def _key(index: int, name: str | None) -> str:
    """The key of a scan, without dots: WebDataset separates key and extension at the first dot."""
    return (
        f"{index:06d}" if name is None else name.replace("%", "%25").replace(".", "%2E")
    )


def _encode(key: str, scan: Scan) -> Iterator[tuple[str, bytes]]:
    """Names and contents of a scan's members; ``_decode`` is the inverse."""
    facts: dict[str, Any] = {
        "id": scan.id,
        "domain": scan.domain,
        "sensor": scan.sensor.to_dict(),
    }
    facts |= {"provenance": dict(scan.provenance)} if scan.provenance else {}
    facts |= {} if scan.pose is None else {"pose": scan.pose.tolist()}
    facts |= {} if scan.label is not None else {"labelled": False}
    fields = {"label": np.full(len(scan), IGNORE, np.uint8)} | scan.fields()
    points = np.column_stack([scan.points, fields.pop("reflectance")]).astype(
        np.float32
    )
    arrays = {"points": points, **fields}
    if scan.boxes is not None:
        arrays["boxes"] = scan.boxes.values
        other = boxes_as_lists(scan.boxes)
        del other["values"]
        facts |= {"names": other.pop("names"), "boxes": other}
    yield f"{key}.json", json.dumps(facts).encode()
    for name, values in arrays.items():
        content = BytesIO()
        np.save(content, values, allow_pickle=False)
        yield f"{key}.{name}.npy", content.getvalue()


def _decode(path: Path, key: str, members: Members, sensor: Sensor | None) -> Scan:
    where = f"scan {shorten(key, 100)!r} of {path}"
    with open_file(path) as file:
        contents = {name: _content(file, *place) for name, place in members.items()}
    facts = parse_json(
        contents.pop("json", b""),
        f"{where}: its json",
        "the members that this package writes",
    )
    arrays = {
        name.removesuffix(".npy"): parse_npy(content, f"{where}: {name}")
        for name, content in contents.items()
        if name.endswith(".npy")
    }
    with parsing(where, "the members that this package writes", SKIP_HINT):
        boxes = None
        if "boxes" in arrays:
            boxes = boxes_from_lists(
                {
                    **facts.get("boxes", {}),  # earlier versions did not write them
                    "values": arrays.pop("boxes"),
                    "names": facts["names"],
                }
            )
        points = arrays.pop("points")
        arrays |= {"points": points[:, :3], "reflectance": points[:, 3]}
        if "labelled" in facts and facts["labelled"] is False:
            del arrays["label"]
        texts = {
            name: json.dumps(facts[name])
            for name in ("sensor", "provenance")
            if name in facts
        }
        arrays |= {name: np.array(text) for name, text in texts.items()}
        arrays |= {
            name: np.array(facts[name])
            for name in ("id", "domain", "pose")
            if name in facts
        }
    scan = decode_scan(arrays, where, sensor)
    scan.boxes = boxes
    scan.id = unquote(key)
    check_scan(scan, where)
    return scan


def _content(file: BinaryIO, offset: int, size: int) -> bytes:
    file.seek(offset)
    return file.read(size)


def _scans(path: Path) -> Iterator[tuple[str, Members]]:
    """Key and members of each scan in a tar file, from its headers.

    Raises:
        FileError, DataError: if it cannot be read, or is not a tar file.
    """
    scans: dict[str, Members] = {}
    with _open(path) as tar:
        for member in tar:
            key, kind = _key_in(member.name)
            if member.isdir():
                continue
            if not member.isreg() or member.issparse():
                raise DataError(
                    f"{path}: {shorten(member.name, 100)!r} is not a plain file",
                    "a file of a WebDataset",
                )
            members = scans.setdefault(key, {})
            if kind in members:
                raise DataError(
                    f"{path} holds {shorten(member.name, 100)!r} twice",
                    "each member once",
                    SKIP_HINT,
                )
            members[kind] = (member.offset_data, member.size)
    yield from scans.items()


def _key_in(name: str) -> tuple[str, str]:
    """The key of a scan in the name of a member, and what follows it."""
    folder, slash, last = name.removeprefix("./").rpartition("/")
    stem, _, kind = last.partition(".")
    return f"{folder}{slash}{stem}", kind


def _merge(shard: Path, new: dict[str, Path]) -> Iterator[tuple[str, bytes]]:
    """The members of a shard, with those of new scans in the place of older ones with their key, or
    at the end."""
    left = dict(new)
    there = _members([shard]) if shard.is_file() else ()
    for key, members in groupby(there, lambda member: _key_in(member[0])[0]):
        yield from _members([left.pop(key)]) if key in left else members
    yield from _members(left.values())


def _members(paths: Iterable[Path]) -> Iterator[tuple[str, bytes]]:
    """The members of several tar files, each name once."""
    done = set()
    for path in paths:
        with _open(path) as tar:
            for member in tar:
                content = tar.extractfile(member)
                if member.name not in done and content is not None:
                    done.add(member.name)
                    yield member.name, content.read()


class _Bounded(BufferedReader):
    """A file that never allocates more memory than its own size, whatever size its headers
    declare."""

    def read(self, size: int | None = -1, /) -> bytes:
        length = os.fstat(self.fileno()).st_size
        return super().read(length if size is None or size < 0 else min(size, length))


@contextmanager
def _open(path: Path) -> Iterator[tarfile.TarFile]:
    """Open a tar file for reading, and convert its errors to those of this package."""
    try:
        with (
            open_file(path) as opened,
            _Bounded(FileIO(opened.fileno(), closefd=False)) as file,
            tarfile.open(fileobj=file, mode="r:", tarinfo=TarMember) as tar,
        ):
            yield tar
    # ValueError: of numbers in pax headers
    except (tarfile.TarError, ValueError) as error:
        if isinstance(error, LidarSynthError):
            raise
        raise DataError(
            f"{path} is truncated, damaged or not a tar file ({error})",
            "a file of a WebDataset",
        ) from error


def _write_tar(file: BinaryIO, members: Iterable[tuple[str, bytes]]) -> None:
    """Write a tar file whose bytes depend only on its members, not on user or time."""
    with tarfile.open(fileobj=file, mode="w") as tar:
        for name, content in members:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            tar.addfile(info, BytesIO(content))
