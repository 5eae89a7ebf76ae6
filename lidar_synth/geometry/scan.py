"""The data that the package passes around: a ``Scan`` of points, its ``Boxes``, and the
``RangeImage``.

All of them are in the sensor frame: right-handed, x forward, y left, z up, metres, float32.
"""

import hashlib
import operator
from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import hash_of_names
from lidar_synth.geometry.sensor import Sensor

REAL = 0
SYNTHETIC = 1
"""Values of ``Scan.domain``."""

CAUSES = "surface", "scattered", "crosstalk"
"""Why a return is where it is, by ``Scan.cause``: the surface that the ray met, particles in
the air, or another pulse."""

LABELLED_ONLY = (
    "Leave out scans without labels; of KITTI-360, open the folder that lidar-synth label kitti360 "
    "wrote (data_3d_semantics_scan), which has the labelled ones only."
)
"""What to do where all scans need labels."""

FARTHEST = 1e5
"""Maximum coordinate, and size of a box, metres; no LiDAR measures farther."""


def wrap_angle(angle: Any) -> Any:
    """An angle, or an array of them, in [-pi, pi), radians."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


@dataclass(eq=False)
class Boxes:
    """Oriented 3-D boxes of one scan.

    Args:
        values: (M, 7) float32: x, y, z of the centre of gravity, length, width, height (metres) and
            yaw (radians, counter-clockwise about +z from +x), in the sensor frame.
        names: M class names as KITTI spells them (``Car``, ``Van``, ``Truck``, ``Pedestrian``,
            ``Person_sitting``, ``Cyclist``, ``Tram``, ``Misc``).
        truncation: (M,) float32 in [0, 1], share of the object outside the image; -1 = not known.
        occlusion: (M,) int8, KITTI's 0 visible, 1 partly, 2 largely, 3 unknown; -1 = not known.
        image_box: (M, 4) float32 left, top, right, bottom in pixels; -1 = not known.
        instance: (M,) int32, the id of the object's track over frames; -1 = not known.
        alpha: (M,) float32 radians, the observation angle in KITTI's label file; -10 = not known.
        dont_care: (K, 4) float32 image rectangles of KITTI's ``DontCare`` regions, which have no
            box.

    Raises:
        DataError: on shapes that do not match each other, non-finite values, sizes that are not
            positive, or values beyond ``FARTHEST``.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Boxes
        >>> boxes = Boxes(np.array([[10, 2, -0.9, 4, 2, 1.6, 0]], np.float32), ("Car",))
        >>> boxes.contain(np.array([(11, 2, -0.5), (11, 4, -0.5)], np.float32))
        array([[ True, False]])
        >>> boxes.corners().shape
        (1, 8, 3)
    """

    values: NDArray[np.float32]
    names: tuple[str, ...]
    truncation: NDArray[np.float32] = None  # type: ignore[assignment]  # filled below
    occlusion: NDArray[np.int8] = None  # type: ignore[assignment]
    image_box: NDArray[np.float32] = None  # type: ignore[assignment]
    instance: NDArray[np.int32] = None  # type: ignore[assignment]
    alpha: NDArray[np.float32] = None  # type: ignore[assignment]
    dont_care: NDArray[np.float32] = field(
        default_factory=lambda: np.zeros((0, 4), np.float32)
    )

    def __post_init__(self) -> None:
        values = np.asarray(self.values, np.float32)
        if values.size and values.shape[-1:] != (7,):
            raise DataError(f"boxes of the shape {values.shape}", "(M, 7)")
        self.values = values.reshape(-1, 7)
        self.names = tuple(self.names)
        count = len(self.values)
        for name, shape, dtype, unknown in (
            ("truncation", (count,), np.float32, -1),
            ("occlusion", (count,), np.int8, -1),
            ("image_box", (count, 4), np.float32, -1),
            ("instance", (count,), np.int32, -1),
            ("alpha", (count,), np.float32, -10),
        ):
            given = getattr(self, name)
            if given is None:
                given = np.full(shape, unknown)
            given = np.asarray(given)
            value = given.astype(dtype)
            if dtype != np.float32 and not np.array_equal(value, given):
                raise DataError(f"boxes: {name} {given.max()}", np.dtype(dtype).name)
            if count == 0 and value.size == 0:  # an empty list has no second axis
                value = value.reshape(shape)
            if value.shape != shape:
                raise DataError(f"boxes: {name} has shape {value.shape}", f"{shape}")
            setattr(self, name, value)
        if len(self.names) != count:
            raise DataError(
                f"boxes: {len(self.names)} names for {count} boxes", "one name per box"
            )
        self.dont_care = np.asarray(self.dont_care, np.float32).reshape(-1, 4)
        known = (
            self.values,
            self.truncation,
            self.image_box,
            self.alpha,
            self.dont_care,
        )
        if (
            not all(np.isfinite(values).all() for values in known)
            or (self.values[:, 3:6] <= 0).any()
        ):
            raise DataError(
                "boxes with a non-finite value or a size that is not positive",
                "metres and radians",
            )
        if (np.abs(self.values) > FARTHEST).any():
            raise DataError(
                f"boxes with a value of {np.abs(self.values).max():g}",
                f"metres within {FARTHEST:g}",
            )

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, keep: Any) -> "Boxes":
        """The boxes that a mask or an index array selects; ``dont_care`` is kept."""
        keep = np.arange(len(self))[keep].reshape(-1)
        picked = {
            f.name: getattr(self, f.name)[keep]
            for f in fields(self)
            if f.name not in ("names", "dont_care")
        }
        return replace(self, names=tuple(self.names[i] for i in keep), **picked)

    def enlarged(self, margin: float) -> "Boxes":
        """The boxes with a margin in metres on all six sides."""
        added = np.array([0, 0, 0, 2 * margin, 2 * margin, 2 * margin, 0], np.float32)
        return replace(self, values=self.values + added)

    def corners(self) -> NDArray[np.float32]:
        """(M, 8, 3) corners in metres: the four of the bottom counter-clockwise from front left,
        then the top's."""
        unit = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)], np.float32) / 2
        unit = np.concatenate(
            [np.c_[unit, np.full(4, -0.5)], np.c_[unit, np.full(4, 0.5)]]
        ).astype(np.float32)
        local = unit[None] * self.values[:, None, 3:6]
        c = np.cos(self.values[:, 6:7])
        s = np.sin(self.values[:, 6:7])
        x = local[..., 0] * c - local[..., 1] * s
        y = local[..., 0] * s + local[..., 1] * c
        return (np.stack([x, y, local[..., 2]], -1) + self.values[:, None, :3]).astype(
            np.float32
        )

    def contain(
        self, points: NDArray[np.float32], above_floor: float = 0.0
    ) -> NDArray[np.bool_]:
        """(M, N) bool: which points lie inside each box, its faces included up to rounding.

        Args:
            points: (N, 3) metres, in the boxes' frame.
            above_floor: metres; points less than this above a box's bottom (the road) count as
                outside.
        """
        inside = np.zeros((len(self), len(points)), bool)
        forward = np.ascontiguousarray(points[:, 0])
        for i, (x, y, z, length, width, height, yaw) in enumerate(self.values):
            reach = np.hypot(length, width)
            near = np.flatnonzero(np.abs(forward - x) <= reach)
            dx = forward[near] - x
            dy = points[near, 1] - y
            dz = points[near, 2] - z
            c = np.cos(yaw)
            s = np.sin(yaw)
            along = dx * c + dy * s
            across = dy * c - dx * s
            inside[i, near] = (
                (abs(along) <= length / 2)
                & (abs(across) <= width / 2)
                & (dz <= height / 2)
                & (dz >= above_floor - height / 2)
            )
        return inside


@dataclass(eq=False)
class Scan:
    """One revolution of a LiDAR: N points in the sensor frame, their fields, boxes and pose.

    Arrays of other types are converted to those below. A scan equals only itself; ``scan_hash``
    tells whether two have the same content.

    Args:
        points: (N, 3) float32 x, y, z in metres.
        reflectance: (N,) float32 in [0, 1].
        sensor: the sensor that recorded the scan, or that a synthetic scan imitates.
        label: (N,) uint8 train ids 0..18, 255 = ignore.
        raw_label: (N,) uint32 as in the file (SemanticKITTI: class in the lower 16 bits, instance
            in the upper), kept so that the scan can be written back without loss.
        instance: (N,) int32 instance ids, 0 = none.
        ring: (N,) int16 ring numbers if the file has them, 0 = highest.
        confidence: (N,) float32 in [0, 1], the confidence of ``label``.
        time: (N,) float32 seconds from the moment of ``pose`` at which each point was measured.
        cause: (N,) uint8, an index of ``CAUSES``, of the points of a corrupted scan.
        boxes: of the objects around the sensor, in the same frame.
        pose: (4, 4) float64, sensor to world, metres.
        image_path: the camera image taken with the scan.
        id: a name that is unique in its source.
        domain: ``REAL`` (0) or ``SYNTHETIC`` (1).
        provenance: what made a synthetic scan, as short texts and numbers: ``made_by`` (``"model"``
            or ``"town"``), ``seed``, and for a model its name ``model`` and ``checkpoint``; empty
            if it is not known. Scans of one origin have the same.
        augmented: the augmentations of the scan in order, ``{name: {parameter: value}}`` with the
            values that were drawn; not written to files.

    Raises:
        DataError: on shapes that do not match each other; as ``to_types``.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import Scan, load_sensor
        >>> points = np.array([(10, 0, -1), (10, 2, -1), (40, -3, 1)], np.float32)
        >>> grey, label = np.full(3, 0.3, np.float32), np.uint8([8, 8, 12])
        >>> scan = Scan(points, grey, load_sensor("hdl64e_kitti"), label=label)
        >>> list(scan.fields())
        ['reflectance', 'label']
        >>> scan[scan.label == 8].points[:, 1]
        array([0., 2.], dtype=float32)
    """

    points: NDArray[np.float32]
    reflectance: NDArray[np.float32]
    sensor: Sensor
    label: NDArray[np.uint8] | None = None
    raw_label: NDArray[np.uint32] | None = None
    instance: NDArray[np.int32] | None = None
    ring: NDArray[np.int16] | None = None
    confidence: NDArray[np.float32] | None = None
    time: NDArray[np.float32] | None = None
    cause: NDArray[np.uint8] | None = None
    boxes: Boxes | None = None
    pose: NDArray[np.float64] | None = None
    image_path: Path | None = None
    id: str = ""
    domain: int = REAL
    provenance: Mapping[str, Any] = field(default_factory=dict)
    augmented: tuple[Mapping[str, Mapping[str, Any]], ...] = ()

    def __post_init__(self) -> None:
        where = f"scan {self.id!r}"
        known = {n: a for n, a in vars(self).items() if n in TYPES and a is not None}
        vars(self).update(to_types(known, where))
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise DataError(
                f"{where}: points of shape {self.points.shape}",
                "(N, 3): x, y, z in metres",
            )
        for name, values in self.fields().items():
            if values.shape != (len(self),):
                raise DataError(
                    f"{where}: {name} has shape {values.shape}",
                    f"({len(self)},), one per point",
                )

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, keep: Any) -> "Scan":
        """The scan with the points that a mask or an index array selects; everything else is
        kept."""
        if (
            isinstance(keep, np.ndarray)
            and keep.dtype == bool
            and keep.shape == (len(self),)
        ):
            keep = np.flatnonzero(keep)  # several times as fast as masks for points
        picked = {name: values[keep] for name, values in self.fields().items()}
        points = (
            self.points.take(keep, 0)
            if isinstance(keep, np.ndarray)
            else self.points[keep]
        )
        return replace(self, points=points, **picked)

    def fields(self) -> dict[str, NDArray[Any]]:
        """The fields that the scan has for each point besides its position: {name: (N,)}."""
        return {
            n: getattr(self, n) for n in POINT_FIELDS if getattr(self, n) is not None
        }

    def noted(self, name: str, **drawn: Any) -> "Scan":
        """The scan with one more augmentation in ``augmented``: its name and the values drawn."""
        return replace(self, augmented=(*self.augmented, {name: drawn}))


TYPES = {
    "points": "f4",
    "range": "f4",
    "pose": "f8",
    "reflectance": "f4",
    "label": "u1",
    "raw_label": "u4",
    "instance": "i4",
    "ring": "i2",
    "confidence": "f4",
    "time": "f4",
    "cause": "u1",
}
"""numpy types of the arrays of a ``Scan`` and a ``RangeImage``."""

POINT_FIELDS = tuple(TYPES)[3:]
"""The fields of a ``Scan`` that hold one value per point, and of a ``RangeImage`` per cell."""


def to_types(arrays: Mapping[str, Any], where: Path | str) -> dict[str, NDArray[Any]]:
    """Arrays in their ``TYPES``; others, and those that have them, stay as they are.

    Args:
        arrays: by name; reflectances divided in numpy, for instance, are float64.
        where: the scan or file, for errors.

    Raises:
        DataError: on integers that the type cannot hold, or no numbers.
    """
    result = {}
    for name, given in arrays.items():
        values = np.asarray(given)
        wanted = np.dtype(TYPES.get(name, values.dtype))
        if values.dtype.kind not in "biuf":
            raise DataError(f"{where}: {name} is {values.dtype}", "numbers")
        # what overflows is refused below, or where points and reflectance are checked
        with np.errstate(all="ignore"):
            cast = np.asarray(values, wanted)
        whole = cast is values or wanted.kind == "f" or np.array_equal(cast, values)
        if not whole:
            outside = values[cast != values].flat[0]
            raise DataError(
                f"{where}: {name} holds {outside}",
                f"whole numbers that {wanted} can hold",
                "Labels are train ids, 255 = ignore." if name == "label" else "",
            )
        result[name] = cast
    return result


def model_provenance(name: str, checkpoint: str, seed: int) -> dict[str, Any]:
    """The provenance of scans that a model generated.

    Args:
        name: the name of the checkpoint.
        checkpoint: its hash.
        seed: the seed of generation.
    """
    return {
        "made_by": "model",
        "model": name,
        "checkpoint": checkpoint,
        "seed": int(seed),
    }


@dataclass(eq=False)
class RangeImage:
    """A scan on the sensor's grid: at most one return per cell.

    Arrays of other types are converted to those of a ``Scan``.

    Args:
        range: (H, W) float32 metres, Euclidean distance; 0 = no return.
        sensor: the sensor that defines the rows and columns.
        channels: {name: (H, W)}, further values of each cell. Channels named in ``POINT_FIELDS``
            become fields of the scan when the image is unprojected. A cell without a return holds
            0, and 255 (ignore) in ``label``.
        boxes: of the objects, which become those of the scan.

    Raises:
        DataError: on a shape that is not the sensor's; as ``to_types``.

    Example:
        >>> import numpy as np
        >>> from lidar_synth import RangeImage, load_sensor, unproject
        >>> distance = np.zeros((64, 1024), np.float32)
        >>> distance[20, 512] = 12.5
        >>> image = RangeImage(distance, load_sensor("hdl64e_kitti"))
        >>> unproject(image).points.round(2)
        array([[12.43, -0.04, -1.3 ]], dtype=float32)
    """

    range: NDArray[np.float32]
    sensor: Sensor
    channels: dict[str, NDArray[Any]] = field(default_factory=dict)
    boxes: Boxes | None = None

    def __post_init__(self) -> None:
        arrays = to_types({"range": self.range, **self.channels}, "range image")
        for name, values in arrays.items():
            if values.shape != self.sensor.shape:
                raise DataError(
                    f"range image: {name} has shape {values.shape}",
                    f"{self.sensor.shape}, the rows and columns of sensor {self.sensor.name!r}",
                )
        self.range = arrays.pop("range")
        self.channels = arrays

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(H, W) bool: which cells have a return."""
        return self.range > 0

    @property
    def reflectance(self) -> NDArray[np.float32] | None:
        """(H, W) float32 in [0, 1], or None."""
        return self.channels.get("reflectance")

    @property
    def label(self) -> NDArray[np.uint8] | None:
        """(H, W) uint8 train ids, 255 = ignore, or None."""
        return self.channels.get("label")


@runtime_checkable
class Source(Protocol):
    """Any indexable collection of scans: a dataset on disk, a bank, a list.

    Example:
        >>> from lidar_synth import Source, open_scans
        >>> scans = open_scans("demo_out/town")
        >>> [isinstance(each, Source) for each in (scans, [scans[0]], iter(scans))]
        [True, True, False]
    """

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Scan: ...


def check_source(source: Any, hint: str = "") -> None:
    """Refuse an object that is no ``Source``; ``hint`` is added to the error.

    Raises:
        ConfigError: on a path, a dict, a single scan, an ``IterableDataset``, or an object without
            a length or an index.
    """
    from torch.utils.data import IterableDataset  # torch loads slowly

    by_number = isinstance(source, Source)
    if isinstance(source, str | Mapping | Scan | IterableDataset) or not by_number:
        raise ConfigError(
            f"{type(source).__name__} as a source of scans",
            "a map-style dataset, with __len__ and __getitem__",
            f"open_scans(path) opens a folder, load_generator('town') a model.{hint}",
        )


def index_of(number: Any, length: int) -> int:
    """The index, 0 <= index < length, of a scan whose number may count from the end.

    Raises:
        TypeError: on anything but a whole number.
        IndexError: unless -length <= number < length.
    """
    try:
        index = operator.index(number)
    except TypeError:
        given = f"scan {number!r}; expected a whole number"
        raise TypeError(f"{given}. Several: [scans[i] for i in range(3)]") from None
    if not -length <= index < length:
        raise IndexError(f"scan {index} of {length}")
    return index % length


def spread(indices: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the indices, evenly spread."""
    count = min(count, len(indices))
    picks = np.unique(np.linspace(0, len(indices) - 1, count).round().astype(int))
    return [indices[i] for i in picks]


def identity_of(source: Any) -> str:
    """A text that identifies a source: its ``identity`` if it has one, otherwise its class, its
    length and a hash of its scans' names.

    For torch's ``Subset``, the hash is of its dataset's identity and its indices; for a
    ``ConcatDataset``, of the identities of its datasets.
    """
    if identity := getattr(source, "identity", ""):
        return str(identity)
    names = getattr(source, "ids", ())
    if isinstance(source, list | tuple):
        names = names or (getattr(scan, "id", "") for scan in source)
    if isinstance(parts := getattr(source, "datasets", None), Iterable):
        names = map(identity_of, parts)
    dataset = getattr(source, "dataset", None)
    indices = getattr(source, "indices", None)
    if isinstance(dataset, Sized) and isinstance(indices, Iterable):
        names = (identity_of(dataset), *indices)
    hashed = hash_of_names(map(str, names))[:16]
    return f"{type(source).__name__}:{len(source)}:{hashed}"


def require_finite(scan: Scan) -> None:
    """Check the points of a scan.

    Raises:
        DataError: if some are NaN or infinite.
    """
    if not np.isfinite(scan.points).all():
        raise DataError(
            f"scan {scan.id!r} with points that are NaN or infinite",
            "finite metres",
            "Drop them: scan[np.isfinite(scan.points).all(1)], or on_bad='drop-points' where "
            "scans are read.",
        )


def require_reflectance(scan: Scan) -> None:
    """Check that the reflectance of a scan is not an intensity on another scale; values outside by
    less than 0.1 pass.

    Raises:
        DataError: if some are NaN, or not in [0, 1].
    """
    values = scan.reflectance
    if not np.abs(values - np.float32(0.5)).max(initial=0) < 0.6:
        raise DataError(
            f"scan {scan.id!r} with a reflectance of {values.min():g} to {values.max():g}",
            "0 to 1",
            "Another scale is divided by its maximum: reflectance_max=255 where scans are read.",
        )


def scan_hash(scan: Scan) -> str:
    """SHA-256 of the points of a scan, their fields and its sensor."""
    digest = hashlib.sha256(repr(scan.sensor).encode())
    for name in ("points", *POINT_FIELDS):
        values = getattr(scan, name)
        if values is not None:
            digest.update(f"{name} {values.dtype} {values.shape} ".encode())
            digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()
