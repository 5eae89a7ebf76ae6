"""Sets of range images: the package's own ``.npz``, and arrays that other code projected.

- ``.npz`` with ``range`` and ``sensor``: the package's own, see npz.py. Lossless for a scan that
  fits the grid.
- ``.npy`` of shape (H, W), range in metres, or (2, H, W), range and reflectance; 0 = no return.
- ``.npz`` with ``image``, or ``.npy``, of shape (H, W, 6): x, y, z, reflectance, range, class per
  cell, as used by several segmentation codes. ``CONVENTIONS`` defines their frames and classes.

As a source of scans, a set has one point per return: on the ray through the cell's centre, or at x,
y, z if the file holds them. ``image`` returns the range image itself.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError, choose
from lidar_synth.files.disk import files_below
from lidar_synth.files.parsing import read_arrays
from lidar_synth.formats.folder import SUFFIXES as OF_POINTS, scan_paths
from lidar_synth.formats.npz import (
    check_numbers,
    decode_range_image,
    range_image,
    read_stored_sensor,
    write_range_image,
)
from lidar_synth.formats.nuscenes import INTENSITY_MAX, ahead
from lidar_synth.formats.points import check_scan
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.formats.writer import DETAILS, GridWriter, project_scan
from lidar_synth.geometry import RangeImage, Scan, Sensor, load_sensor
from lidar_synth.geometry.projection import unproject

SUFFIXES = (".npz", ".npy")

NARROWEST = 64
"""Number of columns from which an array (H, W) is taken for an image, and not for points."""


@dataclass(frozen=True)
class Convention:
    """The meaning of the six values of a cell in (H, W, 6) arrays.

    Args:
        sensor: the preset of the grid.
        reflectance_max: maximum of the reflectance.
        learning_classes: whether the class is one of SemanticKITTI's 0..19 (0 = unlabelled);
            otherwise it is ignored.
        turned: whether x is right and y forward, with the first column to the left.
    """

    sensor: str
    reflectance_max: float = 1.0
    learning_classes: bool = False
    turned: bool = False


CONVENTIONS = {
    "kitti": Convention("hdl64e_semantic_kitti", learning_classes=True),
    "nuscenes": Convention("hdl32e_nuscenes", INTENSITY_MAX, turned=True),
}


class RangeImages(ScanFiles):
    """A folder of range images as .npz or .npy, or one such file.

    Args:
        root: the folder or the file.
        sensor: the sensor of the grid; the package's own files store it.
        convention: ``kitti`` or ``nuscenes``, the meaning of the values of an (H, W, 6) array; by
            default that of the sensor, or else ``kitti``.
        on_bad: see ``ScanFiles``.

    Raises:
        FileError: if the path does not exist.
        ConfigError: on an unknown convention, or files of several kinds.
        DataError: if there is no file.
    """

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """Whether the first array file is an image and not a list of points, and no other file
        holds points."""
        paths = (
            [root]
            if root.is_file()
            else sorted(p for p in files_below(root) if p.suffix in OF_POINTS)
        )
        if not paths or not {path.suffix for path in paths} <= set(SUFFIXES):
            return False
        try:
            arrays = read_arrays(paths[0])
        except DataError:
            return False
        if "array" in arrays:
            shape = arrays["array"].shape
            return len(shape) == 3 or (len(shape) == 2 and shape[1] >= NARROWEST)
        return "range" in arrays or "image" in arrays

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        convention: str | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        root = Path(root)
        ids, self._paths = scan_paths(root, SUFFIXES)
        stored = read_stored_sensor(self._paths[0])
        super().__init__(
            root, ids, sensor if stored is None else None, on_bad, stored=stored
        )
        self._given = None if sensor is None else load_sensor(sensor)
        if convention is None:
            of_sensor = {c.sensor: name for name, c in CONVENTIONS.items()}
            named = "" if self._named is None else self._named.name
            convention = of_sensor.get(named, "kitti")
        self._convention = choose("convention", convention, CONVENTIONS)
        self.options = asdict(self._convention)
        if self._named is None:
            self.sensor = load_sensor(self._convention.sensor)
        self.skip_sensor_check()  # the grid is the sensor's: points on its rays agree with any

    def image(self, index: int) -> RangeImage:
        """The range image at ``index``.

        Raises:
            DataError, FileError: if it cannot be read.
        """
        return self._decode(index)[0]

    def read(self, index: int) -> Scan:
        image, facts, points = self._decode(index)
        scan = unproject(image)
        if points is not None:
            scan.points = points[image.mask]
        for name, value in facts.items():
            setattr(scan, name, value)
        scan.id = self.ids[index]
        check_scan(scan, str(self._paths[index]))
        return scan

    def _decode(
        self, index: int
    ) -> tuple[RangeImage, dict[str, Any], NDArray[np.float32] | None]:
        """The image, further facts of the scan, and (H, W, 3) points if the file holds them."""
        path = self._paths[index]
        arrays = read_arrays(path)
        if "range" in arrays:
            sensor = self._given if "sensor" in arrays else self._named
            return *decode_range_image(arrays, str(path), sensor), None
        array = arrays.get("image", arrays.get("array"))
        if array is None or array.ndim not in (2, 3):
            held = {name: values.shape for name, values in arrays.items()}
            raise DataError(
                f"{path} holds arrays {held}", "range and sensor, or image (H, W, 6)"
            )
        check_numbers(array, str(path))
        with np.errstate(over="ignore"):
            array = array.astype(np.float32)
        if array.ndim == 3 and array.shape[2] == 6:
            return decode_stack(array, self._convention, self.sensor, str(path))
        grid = self.sensor.shape
        if array.shape not in (grid, (2, *grid)):
            raise DataError(
                f"{path} holds an array of shape {array.shape}",
                f"{grid}, {(2, *grid)} or {(*grid, 6)} for {self.sensor.name!r}",
                "--layout folder (layout='folder') reads points.",
            )
        distance, *grey = array if array.ndim == 3 else [array]
        channels = {"reflectance": grey[0]} if grey else {}
        return range_image(distance, self.sensor, channels, str(path)), {}, None


def decode_stack(
    stack: NDArray[np.float32], convention: Convention, sensor: Sensor, where: str
) -> tuple[RangeImage, dict[str, Any], NDArray[np.float32]]:
    """The range image of an (H, W, 6) array, no further facts, and the (H, W, 3) points of its
    cells.

    Raises:
        DataError: if x, y, z and range do not agree, or a value contradicts the convention.
    """
    if not stack.size:
        raise DataError(
            f"{where} holds an array of shape {stack.shape}",
            f"{(*sensor.shape, 6)} for {sensor.name!r}",
        )
    distance = stack[..., 4]
    error = np.abs(np.linalg.norm(stack[..., :3], axis=-1) - distance).max()
    if not error < 1e-3:
        raise DataError(
            f"{where}: x, y, z and range of a cell differ by {error:g} m",
            "x, y, z, reflectance, range, class",
        )
    if stack[..., 3].max() > convention.reflectance_max:
        raise DataError(
            f"{where}: reflectance up to {stack[..., 3].max():g}",
            f"at most {convention.reflectance_max:g}",
            "Another convention may fit: pass sensor='hdl32e_nuscenes', or one of "
            f"{', '.join(CONVENTIONS)}.",
        )
    channels = {"reflectance": stack[..., 3] / np.float32(convention.reflectance_max)}
    if convention.learning_classes:
        classes = stack[..., 5]
        if not np.isin(classes, np.arange(20)).all():
            raise DataError(
                f"{where}: classes up to {classes.max():g}",
                "SemanticKITTI's 0..19, 0 = unlabelled",
            )
        channels["label"] = (classes.astype(np.int16) - 1).astype(np.uint8)
    points = stack[..., :3]
    if convention.turned:
        quarter = stack.shape[1] // 4
        points = np.roll(
            ahead(points.reshape(-1, 3)).reshape(points.shape), quarter, axis=1
        )
        distance = np.roll(distance, quarter, axis=1)
        channels = {
            name: np.roll(values, quarter, axis=1) for name, values in channels.items()
        }
    return range_image(distance, sensor, channels, where), {}, points


class RangeWriter(GridWriter):
    """Writes the package's own ``NAME.npz``: the scan projected onto its sensor's grid, with all
    its fields."""

    suffix = ".npz"
    keeps = frozenset(DETAILS) - {"image_path"}

    def _write_file(self, path: Path, scan: Scan) -> None:
        write_range_image(path, project_scan(scan), scan)
