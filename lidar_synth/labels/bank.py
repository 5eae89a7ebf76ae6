"""A bank of objects: the contents of the boxes of many scans, in one ``.npz`` file.

Arrays of the file (numpy's format, never pickled), for M objects with P points in total::

    format                      "lidar-synth-objects/2"
    sensor                      JSON, the keys of sensors.yaml: the sensor that recorded the objects
    scan                        (M,) text, id of the scan that contains the object
    number                      (M,) int32, index of its box in that scan
    ground                      (M,) float32, metres: height of the ground under it, in that scan's
                                frame
    box_values, box_names ...   the fields of ``Boxes``, in that scan's frame
    start                       (M + 1,) int64, object i has the points start[i] to start[i + 1]
    points                      (P, 3) float32, metres from the box's centre, axes of the sensor
    reflectance, label          (P,) float32 in [0, 1]; (P,) uint8 train ids
    ring                        (P,) int16, 0 = highest; only if the scans have rings, and not in
                                version 1
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm
from typing_extensions import Self

from lidar_synth.datasets.classes import check_labels
from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import hash_of_names, write_arrays
from lidar_synth.files.parsing import parse_json, read_arrays
from lidar_synth.geometry import FARTHEST, Boxes, Scan, Sensor, Source, check_source
from lidar_synth.labels.boxes import join_boxes
from lidar_synth.labels.objects import Object, objects_of

FORMAT = "lidar-synth-objects/2"

READABLE = FORMAT, "lidar-synth-objects/1"
"""Formats that ``load`` reads."""

MOST_BYTES = 1 << 32
"""Maximum size of a bank in memory: a hundred thousand objects of 2,500 points each."""

MOST_PACKED = 64 << 20, 20
"""Maximum size of a file's arrays in memory: a number of bytes, plus a multiple of the file's
size."""


@dataclass(frozen=True, repr=False, eq=False)
class ObjectBank:
    """Objects cut out of many scans; the module's docstring describes the arrays.

    Raises:
        DataError: on shapes that do not match each other, other types, and values that no scan may
            hold.

    Example:
        >>> from lidar_synth import ObjectBank, Town
        >>> objects = ObjectBank.from_scans(Town(seed=0, scans=2))
        >>> objects[0].scan.points.shape == (objects.counts[0], 3)
        True
        >>> objects.save("objects.npz")
        >>> len(ObjectBank.load("objects.npz")) == len(objects)
        True
    """

    sensor: Sensor
    boxes: Boxes
    scan: NDArray[np.str_]
    number: NDArray[np.int32]
    ground: NDArray[np.float32]
    start: NDArray[np.int64]
    points: NDArray[np.float32]
    reflectance: NDArray[np.float32]
    label: NDArray[np.uint8]
    ring: NDArray[np.int16] | None = None

    def __post_init__(self) -> None:
        count = len(self.boxes)
        total = len(self.points)
        rising = (
            len(self.start) == count + 1
            and self.start[0] == 0
            and self.start[-1] == total
        )
        if not (rising and (np.diff(self.start) > 0).all()) or self.points.shape != (
            total,
            3,
        ):
            raise DataError(
                f"{count} objects, {total} points, starts {self.start.shape}",
                "starts of all objects and the end of the last, in increasing order",
            )
        for name, size in {
            "scan": count,
            "number": count,
            "ground": count,
            "reflectance": total,
            "label": total,
            "ring": total,
        }.items():
            if getattr(self, name) is not None and getattr(self, name).shape != (size,):
                raise DataError(
                    f"objects: {name} has shape {getattr(self, name).shape}",
                    f"({size},)",
                )
        self._check_values()

    def _check_values(self) -> None:
        types = {
            "start": "i8",
            "number": "i4",
            "ground": "f4",
            "points": "f4",
            "reflectance": "f4",
            "label": "u1",
            "ring": "i2",
        }
        if wrong := {
            n: str(values.dtype)
            for n, kind in types.items()
            if (values := getattr(self, n)) is not None and values.dtype != kind
        }:
            raise DataError(f"objects: {wrong}", f"{types}")
        for name in ("ground", "points"):
            if not (np.abs(getattr(self, name)) <= FARTHEST).all():  # false for NaN
                raise DataError(
                    f"objects: {name} not finite, or too large",
                    f"metres within {FARTHEST:g}",
                )
        if not ((self.reflectance >= 0) & (self.reflectance <= 1)).all():
            raise DataError(
                f"objects: reflectance {self.reflectance.min()} to {self.reflectance.max()}",
                "0 to 1",
            )
        check_labels(self.label, "objects")

    @classmethod
    def from_scans(
        cls, source: Source, scans: Iterable[int] | None = None, least: int = 5
    ) -> "ObjectBank":
        """Collect the objects in the boxes of a source's scans.

        Args:
            source: of the scans; scans without boxes are left out.
            scans: indices of the scans to use; by default all.
            least: minimum number of points of an object.

        Raises:
            ConfigError: on a path or a single scan.
            DataError: if there is no object in any of the scans, or the scans have several sensors.
        """
        objects: list[tuple[int, Object]] = []
        check_source(source)
        chosen = list(range(len(source)) if scans is None else scans)
        for index in tqdm(
            chosen, "collecting objects", unit="scan", leave=False, disable=None
        ):
            scan = source[index]
            if scan.boxes is not None:
                objects += objects_of(scan, least).items()
        if not objects:
            raise DataError(
                f"no box with {least} points in {len(chosen)} scans",
                "scans with boxes, such as KITTI's or the town's",
            )
        if len(sensors := {o.scan.sensor for _, o in objects}) > 1:
            raise DataError(
                f"objects of the sensors {sorted(s.name for s in sensors)}",
                "one sensor",
            )
        return cls.collect(objects)

    @staticmethod
    def from_town(
        sensor: str | Path | Sensor = "hdl64e_lasers",
        classes: Iterable[str] | None = None,
        scans: int = 60,
        seed: int = 0,
        skin: str | Path | None = None,
    ) -> Any:
        """Collect objects of the town, which need no labelled scans.

        ``paste`` casts each of them anew at its place, by the rays of the scan that it is pasted
        into, with noise and lost returns.

        Args:
            sensor: of the scans that objects are pasted into.
            classes: names of boxes; by default all that the town has of KITTI's. Parked cycles and
                motorcyclists, for whom KITTI has no name, are ``Bicycle``, ``Motorcycle`` and
                ``Motorcyclist``.
            scans: number of scans of the town that objects are taken from, about 12 from each.
            seed: seed of the town.
            skin: the look of a real sensor's returns, as ``load_skin`` takes it.

        Returns:
            A bank whose method ``fit_sizes(boxes)`` gives objects the mean sizes of a dataset's
            boxes. Saved and loaded, it is a plain bank of returns.

        Raises:
            ConfigError: on classes that these scans do not have.
            LibraryError: if embreex is missing.
        """
        # By name: the plugin does not import the laboratory, whose town this is.
        town = import_module("lidar_synth.lab.town")
        names = None if classes is None else list(classes)
        return town.collect_objects(sensor, names, scans, seed, skin)

    @staticmethod
    def from_town_shapes(
        sensor: str | Path | Sensor = "hdl64e_lasers", skin: str | Path | None = None
    ) -> Any:
        """One object of every kind of the town, to be cast into the boxes of layouts: of all
        classes that a layout may have, in about a second.

        Args:
            sensor: of the bank's own returns; what is cast has the sensor of its scan.
            skin: the look of a real sensor's returns, as ``load_skin`` takes it.

        Returns:
            A bank such as that of ``from_town``, whose objects stand in front of the sensor.

        Raises:
            LibraryError: if embreex is missing.
        """
        return import_module("lidar_synth.lab.town").collect_shapes(sensor, skin)

    @classmethod
    def collect(cls, objects: list[tuple[int, Object]]) -> Self:
        """A bank of (number in its scan, object) pairs of one sensor."""
        parts = [o.scan for _, o in objects]
        rings = [p.ring for p in parts if p.ring is not None]
        return cls(
            sensor=parts[0].sensor,
            boxes=join_boxes([p.boxes for p in parts if p.boxes is not None]),
            scan=np.array([p.id for p in parts], np.str_),
            number=np.array([n for n, _ in objects], np.int32),
            ground=np.array([o.ground for _, o in objects], np.float32),
            start=np.cumsum([0, *map(len, parts)], dtype=np.int64),
            points=np.concatenate(
                [o.scan.points - o.box[:3] for _, o in objects]
            ).astype(np.float32),
            reflectance=np.concatenate([p.reflectance for p in parts]).astype(
                np.float32
            ),
            label=np.concatenate([p.fields()["label"] for p in parts]),
            ring=np.concatenate(rings) if len(rings) == len(parts) else None,
        )

    @classmethod
    def load(cls, path: str | Path) -> "ObjectBank":
        """Load a bank from a file.

        Raises:
            FileError: if it cannot be read.
            DataError: if it is not a bank of objects, or damaged.
        """
        path = Path(path)
        with parsing(path, f"a bank of objects ({FORMAT})"):
            size = path.stat().st_size if path.is_file() else 0
            least, factor = MOST_PACKED
            most = min(least + factor * size, MOST_BYTES)
            arrays: dict[str, Any] = read_arrays(path, most=most)
            if str(arrays.pop("format")) not in READABLE:
                raise ValueError("another format")
            sensor = Sensor.from_dict(
                parse_json(str(arrays.pop("sensor")), "its sensor")
            )
            boxes = {f.name: arrays.pop(f"box_{f.name}") for f in fields(Boxes)}
            boxes["names"] = tuple(boxes["names"].tolist())
            return cls(sensor=sensor, boxes=Boxes(**boxes), **arrays)

    def save(self, path: str | Path) -> None:
        """Write the bank to a file; ``load`` is the inverse.

        Raises:
            FileError: if it cannot be written.
        """
        write_arrays(Path(path), self._arrays(), compressed=True)

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of its file by name."""
        arrays = {f.name: getattr(self, f.name) for f in fields(ObjectBank)}
        del arrays["sensor"], arrays["boxes"]
        arrays = {n: values for n, values in arrays.items() if values is not None}
        for f in fields(Boxes):
            arrays[f"box_{f.name}"] = np.asarray(getattr(self.boxes, f.name))
        arrays["format"] = np.array(FORMAT)
        arrays["sensor"] = np.array(json.dumps(self.sensor.to_dict()))
        return arrays

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ObjectBank):
            return NotImplemented
        theirs = other._arrays()
        ours = self._arrays()
        return ours.keys() == theirs.keys() and all(
            np.array_equal(values, theirs[name]) for name, values in ours.items()
        )

    def __len__(self) -> int:
        return len(self.boxes)

    @property
    def identity(self) -> str:
        """A text that distinguishes banks by their boxes."""
        boxes = (*self.boxes.names, *map(str, self.boxes.values.flat))
        return f"{type(self).__name__}:{self.sensor.name}:{hash_of_names(boxes)[:16]}"

    def __repr__(self) -> str:
        return f"ObjectBank({len(self)} objects, {len(self.points)} points, {self.sensor.name})"

    def __getitem__(self, index: int) -> Object:
        """Object ``index`` at the place where it was recorded."""
        if not 0 <= index < len(self):
            raise IndexError(f"object {index} of {len(self)}")
        box = self.boxes[[index]]
        part = slice(self.start[index], self.start[index + 1])
        scan = Scan(
            self.points[part] + box.values[0, :3],
            self.reflectance[part].copy(),
            self.sensor,
            label=self.label[part].copy(),
            ring=None if self.ring is None else self.ring[part].copy(),
            boxes=box,
            id=str(self.scan[index]),
        )
        return Object(scan, float(self.ground[index]))

    @property
    def counts(self) -> NDArray[np.int64]:
        """(M,) number of points of each object."""
        return np.diff(self.start)
