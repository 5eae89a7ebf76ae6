"""``CameraBoxes``, the base class of readers of scans with boxes in a camera's view only."""

from abc import abstractmethod
from copy import copy
from dataclasses import replace

import numpy as np

from lidar_synth.errors import DataError
from lidar_synth.formats.calibration import Calibration, in_view, read_image_size
from lidar_synth.formats.source import ScanFiles
from lidar_synth.geometry import Scan

IMAGE_SIZE = (1242, 375)
"""(width, height) of KITTI's images in pixels, taken where no file tells it."""

FAR = 0.1
"""Share of KITTI's image size by which that of another camera differs; KITTI's principal points
tell its own within 8 %."""


class CameraBoxes(ScanFiles):
    """Scans with points all around, in which objects have boxes only in the view of KITTI's
    camera 2."""

    _cropped = False

    @property
    def beyond_view(self) -> bool:
        """Whether its scans have points outside of the camera's view, where KITTI has no boxes."""
        return not self._cropped

    def with_boxes(self) -> "CameraBoxes":
        """The scans with boxes, cropped to the view of camera 2: KITTI has boxes nowhere else, so
        that a detector would learn that objects outside of the view are background.

        >>> from lidar_synth import open_scans
        >>> scans = open_scans("KITTI")
        >>> boxed = scans.with_boxes()
        >>> print(f"{len(boxed[0].points) / len(scans[0].points):.0%} of the points")
        20% of the points

        Raises:
            DataError: if no scan has boxes.
        """
        ids = [name for name in self.ids if self._has_boxes(name)]
        if not ids:
            raise DataError(f"{self.root} without boxes", "a dataset with them")
        part = copy(self)
        part.ids = tuple(ids)
        part._cropped = True
        part.options = self.options | {"cropped": True}
        return part

    @abstractmethod
    def _has_boxes(self, name: str) -> bool:
        """Whether the boxes of a scan are known, by its id."""

    def _in_view(self, scan: Scan, index: int) -> Scan:
        """The scan, cropped if the source is; raises ``DataError`` if it has no calibration."""
        if not self._cropped:
            return scan
        camera = self.calibration(index)
        if camera is None:
            raise DataError(
                f"scan {scan.id} of {self.root} without calibration",
                "the dataset's calib files, which tell what camera 2 sees",
            )
        return in_view(scan, replace(camera, image_size=assumed_size(camera)))


def assumed_size(camera: Calibration) -> tuple[int, int]:
    """(width, height) of a camera's image in pixels. Where no file tells it, KITTI's if that has
    the principal point near its centre, or else the size that has it in the centre.

    Raises:
        DataError: if no image has it in the centre.
    """
    if camera.image_size:
        return camera.image_size
    centred = np.rint(2 * camera.projection[:2, 2])
    if np.allclose(centred, IMAGE_SIZE, rtol=FAR):
        return IMAGE_SIZE
    return read_image_size(centred, "the principal point of P2")
