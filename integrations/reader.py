"""Banks and planned epochs for environments that cannot hold the package: Python 3.8, numpy 1.23
and h5py are enough.

Copy this one file into a trainer's tree; inside the package it is
``lidar_synth.integrations.reader``. Its scans are the package's own, bit for bit. The package plans
the epochs, the trainer reads them with this file as ``reader``::

    python -m lidar_synth.integrations.plan mix.yaml plan.npz --real 19130 --epochs 50

    train = MixedEpochs("plan.npz", trainer_dataset, Bank("/data/bank"), to_sample=lambda scan: ...)
    train.set_epoch(3)  # before each epoch

It reads banks of the formats "lidar-synth-bank/1" and /2 (with boxes); those compressed with Blosc2
are refused.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import re
import zipfile
import zlib
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

FORMATS = "lidar-synth-bank/1", "lidar-synth-bank/2"  # the second has boxes
PLAN_FORMAT = "lidar-synth-epochs/1"
IGNORE = 255  # label of points without a known class
TYPES = {
    "range": "<u2",
    "reflectance": "|u1",
    "label": "|u1",
    "confidence": "|u1",
    "instance": "<u2",
    "boxes": "<i4",
}
# Of a scan: class + 1, instance, x, y, z, l, w, h in 0.1 mm, yaw in 10 microradians; 0 = unused.
BOXES = (256, 9)
CLASSES = (
    "Car",
    "Van",
    "Truck",
    "Pedestrian",
    "Person_sitting",
    "Cyclist",
    "Tram",
    "Misc",
    "Motorcyclist",
    "Bicycle",
    "Motorcycle",
)
NUMBERS = {"seed": "<u8", "index": "<u8", "crc": "<u4"}  # one for each scan
LEVELS = {"reflectance": 255, "confidence": 15}  # steps from 0 to 1
FILTERS = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32)
REPAIR = "copy it again, or run lidar-synth repair"
PLAN = "python -m lidar_synth.integrations.plan makes a plan"
# Raised by h5py, numpy and json on damaged files.
DAMAGE = (
    AttributeError,
    ArithmeticError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    zipfile.BadZipFile,
    zlib.error,
)


class ReaderError(ValueError):
    """A bank or plan that is missing, damaged, of another version, or does not fit; the text says
    what to do."""


@contextmanager
def _reading(what: object, hint: str) -> Iterator[None]:
    """Convert errors of damaged files to a ``ReaderError`` that names the file."""
    try:
        yield
    except ReaderError:
        raise
    except DAMAGE as error:
        raise ReaderError(f"{what} cannot be read ({error}); {hint}") from error


def _require(condition: object, otherwise: str) -> None:
    if not condition:
        raise ValueError(otherwise)


class Scan(NamedTuple):
    """A synthetic scan, ``<model>/<seed>/<index>``, of N points in the sensor's frame: x forward, y
    left, z up.

    Attributes:
        points: (N, 3) float32 metres.
        reflectance: (N,) float32 in [0, 1]; 0 if the bank has none.
        label: (N,) uint8, SemanticKITTI's train ids 0..18, 255 = ignore; None if the bank has none.
        confidence: (N,) float32 in [0, 1], the confidence of ``label``, or None.
        boxes: (M, 7) float32 x, y, z of the centre, length, width, height, yaw (radians), or None;
            names: M classes.
        instance: (N,) int32, the number of each point's box, from 1 on; 0 = none; or None.
    """

    points: NDArray[Any]
    reflectance: NDArray[Any]
    label: NDArray[Any] | None
    confidence: NDArray[Any] | None
    id: str
    boxes: NDArray[Any] | None = None
    names: tuple[str, ...] | None = None
    instance: NDArray[Any] | None = None


class Bank:
    """The scans of a bank in the folder ``root``, read on access; every scan is checked against its
    CRC.

    A folder without a bank, or a damaged one, raises ``ReaderError``; the latter also when a scan
    is read.

    Attributes:
        fields: what a scan has besides its points: "reflectance", "label", "confidence",
            "instance", "boxes".
        sensor, shape: the sensor, with the keys of ``sensors.yaml``; (rows, columns) of the range
            images.
        identity: the checksum of the index, different for every bank.
    """

    def __init__(self, root: Any) -> None:
        self.root = Path(root)
        values = _read_index(self.root / "index.json")
        self.identity = _checksum(
            {name: value for name, value in values.items() if name != "files"}
        )
        with _reading(self.root / "index.json", REPAIR):
            self._sources = values["sources"]
            self._shards = values["shards"]
            self.sensor = self._sources[0]["sensor"]
            self.fields = tuple(self._sources[0]["fields"])
            self.shape = _shape(self.sensor)
            self._directions = _directions(self.sensor, self.shape)
            # rays start at their lasers
            known = {"elevations", "heights"} <= set(self.sensor)
            lasers = known and "beams" not in self.sensor
            self._starts = np.asarray(
                self.sensor["heights"] if lasers else [0.0] * self.shape[0], np.float32
            )
            self._names = [name for name in TYPES if name in {"range", *self.fields}]
            self._scale = self.sensor["range_max"] / 65535
            for facts in self._sources:
                self._check_facts(facts)
            self._ends = np.cumsum(
                [self._check_entry(entry) for entry in self._shards]
            ).tolist()
            _require(
                values["scans"] == self._ends[-1],
                f"{values['scans']} scans, in shards {self._ends[-1]}",
            )
        self._open: OrderedDict[int, _Shard] = OrderedDict()
        self._process = os.getpid()

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, number: int) -> Scan:
        """The returns of ``image(number)`` through the centres of their cells, row by row."""
        images = self.image(number)
        _, entry, position = self._place(number)
        metres = images.pop("range")
        seen = metres > 0
        points = metres[seen][:, None] * self._directions[seen]
        points[:, 2] += self._starts[seen.nonzero()[0]]
        rows = images.pop("boxes", None)
        fields: Any = {
            "reflectance": np.zeros(len(points), np.float32),
            **{n: v[seen] for n, v in images.items()},
        }
        fields["id"] = (
            f"{self._sources[entry['source']]['model']}/{entry['seed']}/{entry['first'] + position}"
        )
        if rows is not None:
            fields["boxes"] = (rows[:, 2:] * np.array([*6 * [1e-4], 1e-5])).astype(
                np.float32
            )
            fields["names"] = tuple(CLASSES[code - 1] for code in rows[:, 0])
        return Scan(points, **{"label": None, "confidence": None, **fields})

    def image(self, number: int) -> dict[str, NDArray[Any]]:
        """The range image, {name: (rows, columns)}: ``range`` float32 metres, 0 = no return, and
        the fields."""
        shard, entry, position = self._place(number)
        with _reading(f"{self.root / entry['file']}: scan {position}", REPAIR):
            arrays = self._shard(shard).read(position)
        # A millionth away from the sensor's limits, as in the package, so that a projection keeps
        # every return.
        near = self.sensor["range_min"] * (1 + 1e-6)
        far = self.sensor["range_max"] * (1 - 1e-6)
        metres = arrays["range"].astype(np.float32) * np.float32(self._scale)
        inside = np.minimum(np.maximum(metres, np.float32(near)), np.float32(far))
        decoded = {
            **arrays,
            "range": np.where(arrays["range"] > 0, inside, np.float32(0)),
        }
        for name in set(LEVELS) & set(arrays):
            decoded[name] = arrays[name].astype(np.float32) / np.float32(LEVELS[name])
        if "instance" in arrays:
            decoded["instance"] = arrays["instance"].astype(np.int32)
        return decoded

    def verify(self) -> None:
        """Compare every shard with its SHA-256 in the index; raises ``ReaderError`` on the first
        that differs."""
        for entry in self._shards:
            if (
                hashlib.sha256((self.root / entry["file"]).read_bytes()).hexdigest()
                != entry["sha256"]
            ):
                raise ReaderError(
                    f"{self.root / entry['file']} does not match its SHA-256; copy it again"
                )

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": OrderedDict()}

    def _place(self, number: int) -> tuple[int, dict[str, Any], int]:
        """The number of a scan's shard, that shard's entry in the index, and the position in its
        file."""
        if not -len(self) <= number < len(self):
            raise IndexError(f"scan {number} of {len(self)}")
        shard = bisect_right(self._ends, number % len(self))
        rank = number % len(self) - (self._ends[shard - 1] if shard else 0)
        dropped = np.asarray(self._shards[shard].get("dropped", ()), np.int64)
        earlier = np.searchsorted(dropped - np.arange(len(dropped)), rank, side="right")
        return shard, self._shards[shard], rank + int(earlier)

    def _shard(self, number: int) -> _Shard:
        # after a fork the parent's open files are left to the parent
        if self._process != os.getpid():
            self._open = OrderedDict()
            self._process = os.getpid()
        if number not in self._open:
            entry = self._shards[number]
            self._open[number] = _Shard(
                self.root,
                entry,
                self._sources[entry["source"]],
                self._names,
                self.shape,
            )
            if len(self._open) > 16:
                self._open.popitem(last=False)[1].file.close()
        return self._open[number]

    def _check_facts(self, facts: dict[str, Any]) -> None:
        form = FORMATS[bool({"boxes", "instance"} & set(facts["fields"]))]
        _require(
            facts["format"] == form,
            f"scans of format {facts['format']!r}, not {form!r}",
        )
        if facts["compression"] != "gzip":
            raise ReaderError(
                f"{self.root} is compressed by {facts['compression']!r}; bake it with "
                "--compression gzip"
            )
        same = (facts["sensor"], tuple(facts["fields"]), facts["scale"]) == (
            self.sensor,
            self.fields,
            self._scale,
        )
        _require(
            same, "several sensors or fields, or a scale that does not fit the sensor"
        )
        _require(set(self.fields) <= set(TYPES), f"fields {self.fields}")

    def _check_entry(self, entry: dict[str, Any]) -> int:
        """The number of scans that a shard contributes."""
        dropped = entry.get("dropped", [])
        numbers = [
            entry[key] for key in ("seed", "first", "scans", "source", "bytes")
        ] + dropped
        _require(
            all(type(n) is int and 0 <= n < 1 << 64 for n in numbers),
            f"numbers of {entry['file']!r}",
        )
        _require(
            entry["source"] < len(self._sources), f"the source of {entry['file']!r}"
        )
        _require(
            re.fullmatch(r"\w[\w.-]*\.h5", entry["file"]),
            f"the shard {entry['file']!r}",
        )
        # A scan takes 20 bytes for its seed, index and CRC alone.
        _require(
            20 * entry["scans"] <= entry["bytes"],
            f"{entry['bytes']} bytes cannot hold {entry['scans']} scans",
        )
        ascending = np.all(np.diff([-1.0, *dropped, entry["scans"]]) > 0)
        _require(
            ascending and len(dropped) < entry["scans"],
            f"dropped scans of {entry['file']!r}",
        )
        path = self.root / entry["file"]
        size = path.stat().st_size if path.is_file() else 0
        _require(
            size == entry["bytes"], f"{path} is {size} bytes long, not {entry['bytes']}"
        )
        return int(entry["scans"] - len(dropped))


class _Shard:
    """An open shard. Everything that it declares is checked before memory is allocated for it."""

    def __init__(
        self,
        root: Path,
        entry: dict[str, Any],
        facts: dict[str, Any],
        names: list[str],
        shape: Any,
    ) -> None:
        self.entry = entry
        self.shapes = {name: BOXES if name == "boxes" else shape for name in names}
        with _reading(root / entry["file"], REPAIR):
            self.file = h5py.File(str(root / entry["file"]), "r")
            self._check_attributes(facts)
            extra = ["condition"] if "condition" in self.file else []
            _require(
                set(self.file) == {*NUMBERS, *names, *extra},
                f"it holds {sorted(self.file)[:9]}",
            )
            self.numbers = {
                name: np.asarray(self._dataset(name, kind)[:])
                for name, kind in NUMBERS.items()
            }
            self.conditions = self._dataset("condition", None)[:] if extra else None
            self.datasets = {
                name: self._dataset(name, TYPES[name], of)
                for name, of in self.shapes.items()
            }

    def read(self, position: int) -> dict[str, NDArray[Any]]:
        """The arrays of one scan, checked against its CRC."""
        arrays = {name: self._inflate(name, position) for name in self.shapes}
        seed, index, crc = (int(self.numbers[name][position]) for name in NUMBERS)
        condition = b"" if self.conditions is None else bytes(self.conditions[position])
        found = zlib.crc32(
            seed.to_bytes(8, "little") + index.to_bytes(8, "little") + condition
        )
        for array in arrays.values():
            found = zlib.crc32(array.tobytes(), found)
        _require(found == crc, "its CRC does not match")
        own = (seed, index) == (self.entry["seed"], self.entry["first"] + position)
        _require(own, f"it is scan {index} of seed {seed}")
        label, confidence, boxes = (
            arrays.get(n, np.zeros((1, 1))) for n in ("label", "confidence", "boxes")
        )
        _require(((label <= 18) | (label == IGNORE)).all(), "it has labels above 18")
        _require(
            (confidence <= LEVELS["confidence"]).all(), "it has confidences above 1"
        )
        _require(
            ((boxes[:, 0] >= 0) & (boxes[:, 0] <= len(CLASSES))).all(),
            "it has boxes of unknown classes",
        )
        return {
            n: values[values[:, 0] > 0] if n == "boxes" else values
            for n, values in arrays.items()
        }

    def _inflate(self, name: str, position: int) -> NDArray[Any]:
        """One chunk, through the inverse of HDF5's filters fletcher32, deflate and shuffle."""
        place = (position, 0, 0)
        stored = self.datasets[name].id
        info = stored.get_chunk_info_by_coord(place)
        found = (
            info.byte_offset is not None
            and info.byte_offset + info.size <= self.entry["bytes"]
        )
        _require(found and not info.filter_mask, f"its {name} is missing")
        chunk = stored.read_direct_chunk(place)[1]
        dtype = np.dtype(TYPES[name])
        rows, columns = self.shapes[name]
        size = rows * columns * dtype.itemsize
        # The scan's CRC covers HDF5's own Fletcher-32.
        plain = zlib.decompressobj().decompress(chunk[:-4], size + 1)
        _require(len(plain) == size, f"its {name} does not hold {size} bytes")
        planes = np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, -1)
        return np.ascontiguousarray(planes.T).view(dtype).reshape(rows, columns)

    def _check_attributes(self, facts: dict[str, Any]) -> None:
        """The attributes repeat the index: text and numbers as such, everything else as JSON."""
        expected = {
            **facts,
            **{key: self.entry[key] for key in ("seed", "first", "scans")},
        }
        _require(
            set(self.file.attrs) == set(expected),
            "its attributes are not those of the bank's index",
        )
        for name, value in expected.items():
            attribute = self.file.attrs.get_id(name)
            kind = attribute.get_type()
            text = kind.get_class() == h5py.h5t.STRING and not kind.is_variable_str()
            number = kind.get_class() in (h5py.h5t.INTEGER, h5py.h5t.FLOAT)
            _require(
                attribute.shape == ()
                and (text or number)
                and kind.get_size() <= 1 << 20,
                f"its attribute {name}",
            )
            found = self.file.attrs[name]
            if text:
                found = found.decode() if isinstance(found, bytes) else str(found)
                found = found if isinstance(value, str) else json.loads(found)
            _require(found == value, f"{name} differs from the bank's index")

    def _dataset(self, name: str, kind: str | None, shape: tuple[int, ...] = ()) -> Any:
        """A dataset of this file: one value (text if ``kind`` is None) for each scan, or chunks of
        one scan."""
        link = self.file.id.links.get_info(name.encode()).type
        _require(link == h5py.h5l.TYPE_HARD, f"{name} is a link to another object")
        dataset = self.file[name]
        scans = self.entry["scans"]
        # This check comes first: reading the shape of a virtual dataset already opens the files
        # behind it.
        properties = dataset.id.get_create_plist()
        given = dataset.id.get_type()
        layout = properties.get_layout()
        outside = properties.get_external_count()
        _require(
            layout != h5py.h5d.VIRTUAL and not outside,
            f"{name} is stored in another file",
        )
        text = given.get_class() == h5py.h5t.STRING and not given.is_variable_str()
        fits = text if kind is None else given.equal(h5py.h5t.py_create(np.dtype(kind)))
        _require(
            fits and dataset.shape == (scans, *shape),
            f"{name} has another type or shape",
        )
        filters = tuple(
            properties.get_filter(i)[0] for i in range(properties.get_nfilters())
        )
        contiguous = (
            layout == h5py.h5d.CONTIGUOUS
            and dataset.id.get_storage_size() == scans * given.get_size()
        )
        chunked = (
            layout == h5py.h5d.CHUNKED
            and properties.get_chunk() == (1, *shape)
            and filters == FILTERS
        )
        _require(
            shape or scans * given.get_size() <= self.entry["bytes"],
            f"{name} is larger than the file",
        )
        _require(
            chunked if shape else contiguous,
            f"{name} is stored in another way, with filters {filters}",
        )
        return dataset


class MixedEpochs:
    """A map-style dataset of a trainer's real samples and a bank's scans, in the order of a plan.

    The order is already shuffled; a sampler that shuffles again does no harm. ``set_epoch`` reaches
    the workers of a ``DataLoader``, persistent ones included. A damaged plan, or one of another
    bank or number of real samples, raises ``ReaderError``.

    Args:
        plan: file of ``python -m lidar_synth.integrations.plan``; bank: the bank with which it was
            made.
        real: the trainer's own dataset, or a function: number of a real sample -> sample.
        to_sample: Scan -> sample in the trainer's form; by default the ``Scan``.
    """

    def __init__(self, plan: Any, real: Any, bank: Bank, to_sample: Any = None) -> None:
        self.plan = str(plan)
        self.real = real
        self.bank = bank
        self.to_sample = to_sample
        with _reading(plan, PLAN), np.load(self.plan, allow_pickle=False) as file:
            self.settings = json.loads(file["settings"].tobytes().decode())
            form = self.settings["format"]
            planned = self.settings["real"]
            _require(form == PLAN_FORMAT, f"format {form!r}, expected {PLAN_FORMAT!r}")
            _require(
                self.settings["bank"] == bank.identity,
                f"it was made with another bank than {bank.root}",
            )
            given = len(real) if hasattr(real, "__len__") else planned
            _require(
                given == planned,
                f"it is for {planned} real samples, but there are {given}",
            )
        # without a lock, which spawned workers cannot share
        self._epoch = multiprocessing.Value("q", 0, lock=False)
        self._loaded = (-1, np.zeros((0, 2), np.int64))

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, before a ``DataLoader`` begins to iterate; raises ``ReaderError`` after
        the plan's last."""
        if not 0 <= epoch < (planned := len(self.settings["lengths"])):
            raise ReaderError(
                f"epoch {epoch} of a plan of {planned} epochs; make it again with more --epochs"
            )
        self._epoch.value = epoch

    def __len__(self) -> int:
        return int(self.settings["lengths"][self._epoch.value])

    def __getitem__(self, index: int) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        synthetic, number = self._order()[index].tolist()
        if not synthetic:
            if hasattr(self.real, "__getitem__"):
                return self.real[number]
            return self.real(number)
        scan = self._labelled(self.bank[number])
        return scan if self.to_sample is None else self.to_sample(scan)

    def domain(self, index: int) -> int:
        """The domain of the sample at ``index`` in the current epoch: 0 = real, 1 = synthetic."""
        return int(self._order()[index, 0])

    def _labelled(self, scan: Scan) -> Scan:
        """The scan with labels by the plan's label policy: ``generated``, ``condition``, ``boxes``
        or ``none``."""
        label = scan.label
        confidence = scan.confidence
        how = self.settings["labels"]
        threshold = self.settings["threshold"]
        if how == "none":
            return scan._replace(
                label=None, confidence=None, boxes=None, names=None, instance=None
            )
        if how == "boxes" or label is None:
            return scan
        if how == "condition" or confidence is None:
            confidence = (label != IGNORE).astype(np.float32)
        if threshold > 0:
            label = np.where(confidence >= threshold, label, np.uint8(IGNORE))
        return scan._replace(label=label, confidence=confidence)

    def _order(self) -> NDArray[Any]:
        """(N, 2) of the current epoch: whether the sample is synthetic, and its number."""
        epoch = self._epoch.value
        if self._loaded[0] != epoch:
            what = f"{self.plan}: epoch {epoch}"
            with _reading(what, PLAN), np.load(self.plan, allow_pickle=False) as file:
                order = np.asarray(file[f"epoch-{epoch}"])
                _require(
                    order.shape == (len(self), 2) and order.dtype == np.int64,
                    f"{order.shape}, {order.dtype}",
                )
                lengths = np.array([self.settings["real"], len(self.bank)])[order[:, 0]]
                _require(
                    ((order >= 0).all(1) & (order[:, 1] < lengths)).all(),
                    "samples that do not exist",
                )
            self._loaded = (epoch, order)
        return self._loaded[1]


def _read_index(path: Path) -> dict[str, Any]:
    """The values of ``index.json`` without their checksum, which has to match."""
    with _reading(path, f"expected the folder of a finished bank. {REPAIR}"):
        values: dict[str, Any] = json.loads(path.read_bytes().decode())
        given = values.pop("checksum", None)
        form = values.get("format")
        _require(form in FORMATS, f"format {form!r}, expected one of {FORMATS}")
        _require(
            given == _checksum(values),
            "it does not match its checksum: it was damaged or edited",
        )
    return values


def _checksum(values: Any) -> str:
    return hashlib.sha256(
        json.dumps(values, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def _shape(sensor: dict[str, Any]) -> tuple[int, int]:
    """(rows, columns) of a sensor."""
    rows = len(sensor["elevations"]) if "elevations" in sensor else sensor["rows"]
    columns = sensor["columns"]
    whole = type(rows) is int and type(columns) is int and min(rows, columns) >= 2
    _require(
        whole and rows * columns <= 1 << 22,
        f"a sensor of {rows!r} rows and {columns!r} columns",
    )
    _require(
        0 <= sensor["range_min"] < sensor["range_max"] < 1e300,
        "a sensor without limits of its range",
    )
    return rows, columns


def _directions(sensor: dict[str, Any], shape: tuple[int, int]) -> NDArray[Any]:
    """(rows, columns, 3) float32 unit vectors x, y, z through the centres of the cells."""
    rows, columns = shape
    degrees = np.asarray(sensor.get("elevations", ()), np.float64)
    if not len(degrees):
        up = float(sensor["fov_up"])
        down = float(sensor["fov_down"])
        degrees = up - (np.arange(rows) + 0.5) / rows * (up - down)
    _require(
        degrees.shape == (rows,) and (np.abs(degrees) <= 90).all(),
        "a sensor with elevations beyond 90 degrees",
    )
    elevation = np.radians(degrees).astype(np.float32).astype(np.float64)[:, None]
    azimuth = (
        ((2 * ((np.arange(columns) + 0.5) / columns) - 1) * np.pi)
        .astype(np.float32)
        .astype(np.float64)[None]
    )
    x = np.cos(azimuth) * np.cos(elevation)
    y = -np.sin(azimuth) * np.cos(elevation)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], -1).astype(
        np.float32
    )
