"""KITTI raw: complete drives, with boxes if tracklets were annotated.

Layout (https://www.cvlibs.net/datasets/kitti/raw_data.php)::

    DATE/DATE_drive_NNNN_sync/velodyne_points/data/FFFFFFFFFF.bin   float32 x, y, z, reflectance
    DATE/DATE_drive_NNNN_sync/tracklet_labels.xml                   boxes of the whole drive,
                                                                    velodyne frame
    DATE/DATE_drive_NNNN_sync/image_02/data/FFFFFFFFFF.png          left colour camera
    DATE/calib_velo_to_cam.txt, DATE/calib_cam_to_cam.txt

A tracklet is one object: its size, and from ``first_frame`` on one pose per frame, with x, y, z the
centre of the box's *floor* and rz the yaw. The package reads this layout and does not write it.
"""

import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from lidar_synth.errors import DataError, parsing
from lidar_synth.files.disk import (
    list_files,
    name_errors,
    read_file,
    read_named_matrices,
)
from lidar_synth.files.parsing import picture_size
from lidar_synth.formats.calibration import Calibration, homogeneous, read_image_size
from lidar_synth.formats.camera_boxes import CameraBoxes
from lidar_synth.formats.points import read_points
from lidar_synth.formats.source import OnBad
from lidar_synth.geometry import FARTHEST, Boxes, Scan, Sensor, wrap_angle

DRIVES = "*_drive_*/velodyne_points/data"
"""Pattern of the folders with scans, relative to the folder of a date."""

KITTI360 = "2013_05_28_drive_"
"""Begins the names of KITTI-360's drives, whose folders are like those of KITTI raw."""

_IN_NAMES = str.maketrans(" ", "_", "()")
"""Turns a class of KITTI raw, such as "Person (sitting)", into KITTI's name of it."""


class KITTIRaw(CameraBoxes):
    """KITTI's raw drives: <root>/[DATE/]DATE_drive_NNNN_sync/velodyne_points/data/*.bin,
    tracklet_labels.xml.

    If the drive has tracklets, a scan has the boxes of its frame, possibly zero; otherwise
    ``boxes`` is None.

    Args:
        root: the folder that holds the dates, the folder of one date, or the folder of one drive.
        sensor: a preset's name, a YAML file or a ``Sensor``; by default what the folder says
            (``scans.json``), or else ``hdl64e_kitti``.
        on_bad: see ``ScanFiles``.

    Raises:
        DataError: if the folder has no drive, or drives of KITTI-360.

    Example:
        >>> from lidar_synth import KITTIRaw
        >>> scans = KITTIRaw("KITTI-raw")
        >>> scans.ids[1]
        '2011_09_26_drive_0001_sync/0000000001'
        >>> scans[1].boxes.names
        ('Person_sitting',)
    """

    default_sensor = "hdl64e_kitti"

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        patterns = ("velodyne_points/data", DRIVES, f"*/{DRIVES}")
        return any(any(root.glob(p)) for p in patterns)

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        root = Path(root)
        own = [root] if (root / "velodyne_points" / "data").is_dir() else []
        found = own or [
            p.parent.parent
            for pattern in (DRIVES, f"*/{DRIVES}")
            for p in sorted(root.glob(pattern))
        ]
        self._drives = {drive.resolve().name: drive for drive in found}
        if any(name.startswith(KITTI360) for name in self._drives):
            raise DataError(
                f"{root} has drives of KITTI-360",
                "drives of KITTI raw",
                "Give the folder that holds data_3d_raw, the folder of KITTI-360's drives.",
            )
        ids = [
            f"{name}/{path.stem}"
            for name, drive in self._drives.items()
            for path in list_files(drive / "velodyne_points" / "data", ".bin")
        ]
        super().__init__(root, ids, sensor, on_bad)
        self._boxes: dict[str, dict[int, Boxes] | None] = {}

    def read(self, index: int) -> Scan:
        name, frame = self.ids[index].split("/")
        drive = self._drives[name]
        points = read_points(drive / "velodyne_points" / "data" / f"{frame}.bin")
        image = drive / "image_02" / "data" / f"{frame}.png"
        if name not in self._boxes:
            path = drive / "tracklet_labels.xml"
            self._boxes[name] = read_tracklets(path) if path.is_file() else None
        boxes = self._boxes[name]
        found = None
        if boxes is not None and frame.isdecimal():
            found = boxes.get(int(frame), Boxes(np.zeros((0, 7), np.float32), ()))
        scan = Scan(
            points[:, :3],
            points[:, 3],
            self.sensor,
            boxes=found,
            image_path=image if image.is_file() else None,
            id=self.ids[index],
        )
        return self._in_view(scan, index)

    def _has_boxes(self, name: str) -> bool:
        drive = self._drives[name.split("/")[0]]
        return (drive / "tracklet_labels.xml").is_file()

    def calibration(self, index: int) -> Calibration | None:
        name, frame = self.ids[index].split("/")
        drive = self._drives[name]
        return read_calibration(
            drive.resolve().parent,
            picture_size(drive / "image_02" / "data" / f"{frame}.png"),
        )


def read_calibration(
    folder: Path, image_size: tuple[int, int] | None = None
) -> Calibration | None:
    """Camera 2 of a day's calibration; None if its two files are missing.

    Raises:
        DataError: if a matrix is missing or invalid.
    """
    paths = folder / "calib_velo_to_cam.txt", folder / "calib_cam_to_cam.txt"
    if not all(path.is_file() for path in paths):
        return None
    velo, cam = map(read_named_matrices, paths)
    with parsing(
        f"{paths[0]} and {paths[1]}", "R and T; R_rect_00, P_rect_02 and S_rect_02"
    ):
        to_cam_0 = homogeneous(
            np.column_stack([velo["R"].reshape(3, 3), velo["T"].reshape(3, 1)])
        )
        rectify = homogeneous(cam["R_rect_00"].reshape(3, 3))
        projection = cam["P_rect_02"].reshape(3, 4)
        size = image_size or read_image_size(cam["S_rect_02"], "S_rect_02")
        return Calibration(projection, rectify @ to_cam_0, size)


def read_tracklets(path: Path) -> dict[int, Boxes]:
    """{frame: boxes} of a drive, in the sensor frame; a box's instance is the tracklet's number in
    the file, from 1.

    Truncation is known (0) only if the tracklet marks the object as completely in the image.

    Raises:
        FileError: if it cannot be read.
        DataError: if it is not a tracklet file.
    """
    rows: dict[int, list[Any]] = defaultdict(list)
    with parsing(path, "KITTI's tracklet_labels.xml"):
        tracklets = ElementTree.fromstring(read_file(path)).findall("tracklets/item")
        for instance, tracklet in enumerate(tracklets, 1):
            name = tracklet.findtext("objectType", "").translate(_IN_NAMES)
            height, width, length = (float(tracklet.findtext(tag, "")) for tag in "hwl")
            for k, pose in enumerate(tracklet.findall("poses/item")):
                x, y, floor, yaw = (
                    float(pose.findtext(tag, "")) for tag in ("tx", "ty", "tz", "rz")
                )
                box = (
                    x,
                    y,
                    floor + height / 2,
                    length,
                    width,
                    height,
                    wrap_angle(yaw),
                )
                hidden = int(pose.findtext("occlusion", "-1"))
                whole = pose.findtext("truncation") == "0"
                frame = int(tracklet.findtext("first_frame", "")) + k
                rows[frame].append(
                    (
                        box,
                        name,
                        hidden if 0 <= hidden <= 2 else -1,
                        0 if whole else -1,
                        instance,
                    )
                )
    boxes = {}
    for frame, found in sorted(rows.items()):
        values, names, occlusion, truncation, instances = zip(*found, strict=True)
        if not (np.abs(values) <= FARTHEST).all():  # NaN is not
            raise DataError(
                f"{path}: a box of frame {frame} with {values}",
                f"metres within {FARTHEST:g}, and radians",
            )
        with name_errors(path):
            boxes[frame] = Boxes(
                np.array(values),
                names,
                truncation=np.array(truncation),
                occlusion=np.array(occlusion),
                instance=np.array(instances),
            )
    return boxes
