"""Camera calibration: the projection of points from the sensor frame into a camera's image, and the
part of a scan that the camera sees."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import DataError
from lidar_synth.files.disk import LARGEST_IMAGE, write_named_matrices
from lidar_synth.geometry import Scan

Matrix = NDArray[np.float64]

NOT_RIGID = 0.01
"""Tolerance of R R^T against the identity; rotations in KITTI's files have six digits."""


@dataclass(frozen=True)
class Calibration:
    """One rectified camera. Its frame is x right, y down, z forward, metres.

    Args:
        projection: (3, 4) float64, the camera's P: pixels of points in the rectified camera frame.
        camera_from_sensor: (4, 4) float64 rigid transform from the sensor frame to the camera
            frame.
        image_size: (width, height) in pixels; None if unknown.
        matrices: the original matrices of the dataset's calibration files by name, so that they can
            be written back without loss.

    Raises:
        DataError: on another shape, a transform that is not rigid, or an impossible image size.
    """

    projection: Matrix
    camera_from_sensor: Matrix
    image_size: tuple[int, int] | None = None
    matrices: Mapping[str, Matrix] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, shape in (("projection", (3, 4)), ("camera_from_sensor", (4, 4))):
            value = np.asarray(getattr(self, name), np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise DataError(
                    f"calibration: {name} of shape {value.shape}",
                    f"{shape}, all values finite",
                )
            object.__setattr__(self, name, value)
        check_rigid(self.camera_from_sensor, "calibration: camera_from_sensor")
        if self.image_size is not None and not all(
            1 <= n <= LARGEST_IMAGE for n in self.image_size
        ):
            raise DataError(
                f"calibration: an image of {self.image_size} pixels",
                f"1 to {LARGEST_IMAGE} each way",
            )

    @property
    def image_from_sensor(self) -> Matrix:
        """(3, 4) projection from homogeneous points in the sensor frame to homogeneous pixels."""
        return self.projection @ self.camera_from_sensor

    @property
    def sensor_from_camera(self) -> Matrix:
        """(4, 4) rigid transform from the camera frame to the sensor frame."""
        return np.asarray(np.linalg.inv(self.camera_from_sensor), np.float64)

    def pixels(self, points: NDArray[np.floating]) -> tuple[Matrix, Matrix]:
        """Project points into the image.

        Args:
            points: (N, 3) metres, sensor frame.

        Returns:
            (N, 2) column and row in pixels, NaN for points in or behind the camera's plane, and
            (N,) depth in metres along the optical axis. A point is in the image if its pixel is
            within ``image_size``.
        """
        matrix = self.image_from_sensor
        homogeneous = np.asarray(points, np.float64) @ matrix[:, :3].T + matrix[:, 3]
        depth = homogeneous[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = np.where(
                depth[:, None] > 0, homogeneous[:, :2] / depth[:, None], np.nan
            )
        return pixels, depth


def write_kitti_camera(
    path: Path, camera: Calibration, transforms: dict[str, Matrix]
) -> None:
    """Write a camera as in KITTI: a dataset's own matrices unchanged; another camera as all four.

    Args:
        path: the file.
        camera: the camera; its matrices are a dataset's own if all those of KITTI are among them,
            except ``Tr_imu_to_velo``.
        transforms: of another camera, by KITTI's names.

    Raises:
        FileError: if it cannot be written.
    """
    lines = dict.fromkeys(("P0", "P1", "P2", "P3"), camera.projection) | transforms
    own = lines.keys() - {"Tr_imu_to_velo"} <= camera.matrices.keys()
    write_named_matrices(path, camera.matrices if own else lines)


def in_view(scan: Scan, camera: Calibration) -> Scan:
    """Crop a scan to a camera's image: the points that project into it, and the boxes whose centres
    do or that hold such points, as KITTI labels objects that the image's edge cuts.

    Raises:
        DataError: if the camera's image size is unknown.
    """
    size = camera.image_size
    if size is None:
        raise DataError("a camera without image size", "width and height, from image_2")

    def seen(points: NDArray[np.float32]) -> NDArray[np.bool_]:
        pixels, depth = camera.pixels(points)
        with np.errstate(invalid="ignore"):
            inside: NDArray[np.bool_] = (
                (pixels >= 0).all(1) & (pixels < np.array(size)).all(1) & (depth > 0)
            )
        return inside

    part = scan[seen(scan.points)]
    if scan.boxes is not None:
        held = scan.boxes.contain(part.points).any(1)
        part.boxes = scan.boxes[seen(scan.boxes.values[:, :3]) | held]
    return part


def check_rigid(transforms: Matrix, where: str) -> None:
    """Refuse poses or calibrations that are not rigid transforms.

    Args:
        transforms: (..., 4, 4), or (..., 3, 4) without the last row.
        where: name of the transforms in the error.

    Raises:
        DataError: on values that are not finite, or a left 3 x 3 part that is not a rotation within
            ``NOT_RIGID``.
    """
    rotations = transforms[..., :3, :3].reshape(-1, 3, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(rotations @ rotations.swapaxes(-1, -2) - np.eye(3)).max(
            axis=(1, 2), initial=0
        )
        sound = (off < NOT_RIGID) & (np.linalg.det(rotations) > 0)
    sound &= np.isfinite(transforms).all(axis=(-1, -2)).reshape(-1)
    if not sound.all():
        first = int(np.flatnonzero(~sound)[0])
        raise DataError(
            f"{where}: {np.count_nonzero(~sound)} of {len(sound)} transforms are not rigid, the "
            "first is number "
            f"{first}: {transforms.reshape(-1, *transforms.shape[-2:])[first].tolist()}",
            "finite numbers whose left 3 x 3 part is a rotation",
        )


def read_image_size(values: Matrix, where: str) -> tuple[int, int]:
    """Parse an image size, (width, height) in pixels, of a calibration file.

    Raises:
        DataError: on anything but two integers of a possible image size.
    """
    if (
        values.shape != (2,)
        or not (
            (values >= 1) & (values <= LARGEST_IMAGE) & (values == np.rint(values))
        ).all()
    ):
        raise DataError(
            f"{where}: an image of {values.tolist()} pixels",
            f"two whole numbers, 1 to {LARGEST_IMAGE}",
        )
    return int(values[0]), int(values[1])


def homogeneous(matrix: Matrix) -> Matrix:
    """(4, 4) homogeneous matrix of 9 values (a rotation) or 12 (rotation and translation, row by
    row)."""
    result = np.eye(4)
    matrix = np.asarray(matrix, np.float64).reshape(3, -1)
    result[:3, : matrix.shape[1]] = matrix
    return result


AXES_CAMERA_FROM_SENSOR: Matrix = np.array(
    [(0, -1, 0, 0), (0, 0, -1, 0), (1, 0, 0, 0), (0, 0, 0, 1)], np.float64
)
"""(4, 4) rotation from x forward, y left, z up to a camera's x right, y down, z forward."""


def ideal_camera(focal: float, image_size: tuple[int, int]) -> Calibration:
    """A pinhole camera at the sensor's origin that faces forward.

    Args:
        focal: focal length in pixels.
        image_size: (width, height) in pixels; the principal point is the centre.
    """
    width, height = image_size
    projection = np.array(
        [(focal, 0, width / 2, 0), (0, focal, height / 2, 0), (0, 0, 1, 0)]
    )
    return Calibration(projection, AXES_CAMERA_FROM_SENSOR, image_size)
