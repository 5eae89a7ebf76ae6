"""KITTI-360: drives of an HDL-64E with poses, calibration, boxes and optional labels per scan.

Layout (https://www.cvlibs.net/datasets/kitti-360/documentation.php)::

    data_3d_raw/DRIVE/velodyne_points/data/FFFFFFFFFF.bin      float32 x, y, z, reflectance;
                                                               sensor frame
    data_2d_raw/DRIVE/image_00/data_rect/FFFFFFFFFF.png        rectified left camera
    data_poses/DRIVE/poses.txt                                 F and 12 numbers: the car's IMU at
                                                               frame F to world
    data_3d_bboxes/train/DRIVE.xml                             boxes, see kitti360_boxes.py
    data_3d_semantics_scan/DRIVE/labels/FFFFFFFFFF.label       labels per scan, see below
    data_3d_semantics_scan/DRIVE/confidence/FFFFFFFFFF.bin     uint8 per point, 255 = certain
    calibration/perspective.txt                                P_rect_00, R_rect_00
    calibration/calib_cam_to_velo.txt, calib_cam_to_pose.txt   camera 0 to velodyne; each camera to
                                                               the IMU

The dataset publishes labels of accumulated clouds only. ``lidar-synth label kitti360`` recovers
labels per scan from them (kitti360_labels.py), and so does
github.com/JulesSanchez/recoverKITTI360label, which writes DRIVE/labels/FFFFFFFFFF.bin: int16 per
point, KITTI-360's semantic id, -1 = none found. Under data_3d_semantics_scan, the reader accepts
both and distinguishes the two encodings by their size: two bytes per point are the encoding of that
tool, four are SemanticKITTI's packing (KITTI-360's semantic id in the lower 16 bits, instance
above), which the writer uses. Only frames of annotated windows can have labels; all others are read
without labels, unless the path that is opened is that of the labels: ``data_3d_semantics_scan``, or
the folder that the command wrote, whose ``report.json`` names the dataset's root.

The pose of a ``Scan`` is velodyne to world: pose calib_cam_to_pose[image_00] calib_cam_to_velo^-1.
"""

from collections.abc import Set
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import KITTI360 as CLASSES, MAX_INSTANCES, MOVING
from lidar_synth.datasets.recordings import KITTI360_SPLITS
from lidar_synth.errors import ConfigError, DataError, choose
from lidar_synth.files.disk import list_files, read_file, read_values
from lidar_synth.files.parsing import read_facts
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.description import NAME
from lidar_synth.formats.folder import boxes_as_lists
from lidar_synth.formats.kitti360_boxes import (
    OBJECTS,
    WorldBoxes,
    read_boxes,
    write_boxes,
)
from lidar_synth.formats.kitti360_poses import (
    CAMERA,
    fill_poses,
    read_calibration,
    read_poses,
    write_calibration,
    write_poses,
)
from lidar_synth.formats.point_labels import (
    decode_labels,
    encode_labels,
    mismatch,
    write_labels,
)
from lidar_synth.formats.points import read_points
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.formats.writer import (
    LABELS,
    Picture,
    Writer,
    clear_notes,
    drive_and_frame,
    read_notes,
    write_image,
    write_note,
)
from lidar_synth.geometry import Boxes, Scan, Sensor

SPLITS = KITTI360_SPLITS
"""Drives of each split, named after the work that introduced it; None = all existing drives. The
splits overlap: LiDM trains on drives on which R2Flow tests."""

LABELLED = "data_3d_semantics_scan"
"""The folder of labels per scan."""


class KITTI360(ScanFiles):
    """KITTI-360's drives: <root>/data_3d_raw/DRIVE/velodyne_points/data/*.bin with poses, boxes,
    calibration, images.

    A scan has labels if its label file exists, and boxes if it has a pose and lies in a window of
    the drive that was annotated with boxes. The dataset leaves out poses where the car hardly
    moved; they are filled (``fill_poses``).

    Args:
        root: the folder that holds ``data_3d_raw``; or that of labels, ``data_3d_semantics_scan``
            or what ``lidar-synth label kitti360`` wrote, for the labelled scans alone.
        split: the full name of a split, such as ``r2flow/train``, or ``all``.
        labels: the folder with ``data_3d_semantics_scan``; then only scans that have labels there
            are read, as if ``root`` were that of labels.
        sensor: a preset's name, a YAML file or a ``Sensor``; by default what the folder says
            (``scans.json``), or else ``hdl64e_kitti360``.
        on_bad: see ``ScanFiles``.

    Raises:
        ConfigError: on an unknown split; ``train`` alone is unknown, because published works split
            the drives differently.
        DataError: if the folder has none of the split's drives, or ``labels`` has none of its
            scans.

    Example:
        >>> from lidar_synth import KITTI360
        >>> scans = KITTI360("KITTI-360", split="r2flow/train")
        >>> scans.ids[0]
        '2013_05_28_drive_0004_sync/0000000000'
        >>> scan = scans[0]
        >>> scan.boxes.values.shape == (len(scan.boxes), 7), scan.pose.shape
        (True, (4, 4))
    """

    default_sensor = "hdl64e_kitti360"

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        return folders_of(root)[1] is not None or (root / "data_3d_raw").is_dir()

    def __init__(
        self,
        root: str | Path,
        split: str = "all",
        *,
        labels: str | Path | None = None,
        sensor: str | Path | Sensor | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        home, found = folders_of(Path(root))
        labels = found if labels is None else labels
        drives = drives_of(home, split)
        ids = [
            f"{d}/{path.stem}"
            for d in drives
            for path in list_files(scans_folder(home, d), ".bin")
        ]
        self._labels = home if labels is None else Path(labels)
        if labels is not None:
            ids = [name for name in ids if label_file(self._labels, *name.split("/"))]
            if not ids:
                raise DataError(
                    f"{labels} has no labels of scans of {home}",
                    "data_3d_semantics_scan/DRIVE/labels/FFFFFFFFFF.label",
                    f"lidar-synth label kitti360 {home} {labels} makes them from the accumulated "
                    "clouds.",
                )
        super().__init__(home, ids, sensor, on_bad)
        if self._labels not in (home, found):
            self.options["labels"] = str(self._labels.resolve())
        self.root = Path(root)  # by which others open the same scans
        self._home = home
        self._camera = read_calibration(home)
        self._poses = {
            d: fill_poses(read_poses(home, d, self._camera), frames_of(home, d))
            for d in drives
        }
        self._boxes: dict[str, WorldBoxes | None] = {}

    def read(self, index: int) -> Scan:
        drive, frame = self.ids[index].split("/")
        path = scans_folder(self._home, drive) / f"{frame}.bin"
        points = read_points(path)
        pose = self._poses[drive].get(int(frame)) if frame.isdecimal() else None
        image = image_path(self._home, drive, frame)
        return Scan(
            points[:, :3],
            points[:, 3],
            self.sensor,
            **read_scan_labels(self._labels, drive, frame, path, len(points)),
            boxes=self._scan_boxes(drive, int(frame), pose)
            if pose is not None
            else None,
            pose=pose,
            image_path=image if image.is_file() else None,
            id=self.ids[index],
        )

    def files_for(self, fields: Set[str]) -> list[Path]:
        """See ``ScanFiles.files_for``: nothing of other drives, except for layouts, which are made
        of everything."""
        root = self._home
        found = [root if "layout" in fields else root / NAME]
        for drive in sorted({name.partition("/")[0] for name in self.ids}):
            found.append(scans_folder(root, drive))
            if fields & {"label", "semantic", "layout"}:
                found.append(labels_folder(self._labels, drive))
            if "camera" in fields:
                found.append(image_path(root, drive, "").parent)
        return found

    def calibration(self, index: int) -> Calibration | None:
        return self._camera

    def _scan_boxes(
        self, drive: str, frame: int, pose: NDArray[np.float64]
    ) -> Boxes | None:
        if drive not in self._boxes:
            path = boxes_path(self._home, drive)
            self._boxes[drive] = None if path is None else read_boxes(path)
        boxes = self._boxes[drive]
        return None if boxes is None else boxes.at(frame, pose, self.sensor.range_max)


class KITTI360Writer(Writer):
    """Writes KITTI-360's layout: scans, poses, calibration, boxes, images and labels per scan.

    Drive and frame of an id ``DRIVE/FFFFFFFFFF`` are kept, and those of SemanticKITTI's sequences
    (sequence 03 is drive 0003); all other scans go into ``drive``, numbered by index. Boxes are
    written for each frame with their timestamp, as the dataset does for moving objects. A scan with
    boxes but without a pose gets the identity as its pose, so that its world frame is its sensor
    frame.

    Args:
        root: output folder.
        drive: folder of scans without a drive of their own.
        calibration: see ``Writer``.
    """

    keeps = LABELS | {"boxes", "pose", "image_path"}

    def __init__(
        self,
        root: str | Path,
        *,
        drive: str = "2013_05_28_drive_0000_sync",
        calibration: Calibration | None = None,
    ) -> None:
        super().__init__(root, calibration=calibration)
        if not drive or "/" in drive:
            raise ConfigError(
                f"drive {drive!r}",
                "a folder's name, such as 2013_05_28_drive_0000_sync",
            )
        self.drive = drive

    def _place(self, index: int, name: str | None) -> str:
        drive = self.drive
        if kept := drive_and_frame(name, 10):
            drive, index = f"2013_05_28_drive_00{kept[0]}_sync", kept[1]
        return (scans_folder(Path(), drive) / f"{index:010d}.bin").as_posix()

    def _put(
        self,
        scan: Scan,
        path: Path,
        picture: Picture | None,
        camera: Calibration | None,
    ) -> None:
        drive = path.parents[2].name
        frame = path.stem
        if not (self.root / "calibration" / "perspective.txt").is_file():
            write_calibration(self.root, camera or CAMERA)
        write_note(self.root / "data_poses" / drive, int(frame), _facts(scan))
        if picture is not None:
            write_image(image_path(self.root, drive, frame), picture)
        if scan.label is not None:
            write_labels(
                labels_folder(self.root, drive) / f"{frame}.label", label_values(scan)
            )
        self._write_points(path, scan)

    def loses(self, scan: Scan, camera: Calibration | None) -> list[str]:
        lost = super().loses(scan, camera)
        known = {name for *_, name in OBJECTS.values()}
        if scan.boxes and set(scan.boxes.names) - known:
            lost.append("names of boxes")
        if scan.label is not None:
            kept = decode_labels(label_values(scan), CLASSES, scan.id)["label"]
            if (kept != scan.label).any():
                lost.append("classes of points")
        return lost

    def finish(self) -> None:
        for folder in sorted((self.root / "data_poses").glob("*")):
            notes, new = read_notes(folder)
            poses = read_poses(self.root, folder.name, read_calibration(self.root))
            write_poses(self.root, folder.name, new)
            poses |= new
            boxes = {
                f: (Boxes(**note["boxes"]), poses[f])
                for f, note in notes.items()
                if note["boxes"]
            }
            if boxes:
                write_boxes(
                    self.root / "data_3d_bboxes" / "train" / f"{folder.name}.xml", boxes
                )
            clear_notes(folder)


def label_values(scan: Scan) -> NDArray[np.uint32]:
    """(N,) values of a scan's label file: KITTI-360's id, and above it id * 1000 + n, which labels
    and boxes use. Moving objects, which SemanticKITTI counts apart, count from 999 down.

    Raises:
        DataError: on a train id or an instance that the file cannot hold.
    """
    labels = encode_labels(scan, CLASSES)
    if labels is scan.raw_label:
        return labels
    ids = labels & 0xFFFF
    instances = labels >> 16
    local = (instances > 0) & (instances < MAX_INSTANCES)
    if scan.raw_label is not None and scan.boxes is None:  # boxes have the old numbers
        moving = local & (scan.raw_label & 0xFFFF >= MOVING)
        instances = np.where(moving, MAX_INSTANCES - instances, instances)
    return np.asarray(ids | (instances + local * ids * MAX_INSTANCES) << 16, np.uint32)


def _facts(scan: Scan) -> dict[str, Any]:
    """The note of a scan. Boxes have the instances of their points in its label file."""
    pose = scan.pose
    boxes = None
    if scan.boxes is not None:
        pose = np.eye(4) if pose is None else pose
        boxes = boxes_as_lists(scan.boxes)
        if scan.label is not None and scan.instance is not None:
            written = label_values(scan) >> 16
            for i, number in enumerate(boxes["instance"]):
                own = written[scan.instance == number]
                if len(own):  # most of them: single points may have another label
                    boxes["instance"][i] = int(np.bincount(own).argmax())
    return {"pose": pose, "boxes": boxes}


def folders_of(path: Path) -> tuple[Path, Path | None]:
    """The dataset's root, and the folder with ``data_3d_semantics_scan`` if ``path`` is one of
    labels, whose scans alone are meant.

    Raises:
        FileError, DataError: if the report of the labels cannot be read.
    """
    labels = path.parent if path.name == LABELLED else path
    if (labels / "data_3d_raw").is_dir():
        return labels, None if labels == path else labels
    report = labels / LABELLED / "report.json"
    if not report.is_file():
        return path, None
    facts = read_facts(report, "the report of lidar-synth label kitti360")
    return Path(str(facts.get("root", path))), labels


def scans_folder(root: Path, drive: str) -> Path:
    """The folder of a drive's scans."""
    return root / "data_3d_raw" / drive / "velodyne_points" / "data"


def frames_of(root: Path, drive: str) -> list[int]:
    """The frames of a drive's scans."""
    names = (path.stem for path in list_files(scans_folder(root, drive), ".bin"))
    return [int(name) for name in names if name.isdecimal()]


def image_path(root: Path, drive: str, frame: str) -> Path:
    """The rectified image of camera 0 at a frame."""
    return root / "data_2d_raw" / drive / "image_00" / "data_rect" / f"{frame}.png"


def drives_of(root: Path, split: str) -> list[str]:
    """The drives of a split that a folder has.

    Raises:
        ConfigError: on an unknown split.
        DataError: if it has none of them.
    """
    hint = (
        "Published works split the drives differently: give the full name of a split."
    )
    wanted = choose("KITTI-360 split", split, SPLITS, hint)
    existing = sorted(
        p.parent.parent.name
        for p in (root / "data_3d_raw").glob("*/velodyne_points/data")
    )
    drives = [d for d in existing if wanted is None or d in wanted]
    if not drives:
        raise DataError(
            f"{root} has no drive of split {split!r} (it has "
            f"{', '.join(existing) or 'none at all'})",
            "data_3d_raw/2013_05_28_drive_NNNN_sync/velodyne_points/data/*.bin",
            "If the dataset of a folder of labels has moved, run lidar-synth label kitti360 again.",
        )
    return drives


def boxes_path(root: Path, drive: str) -> Path | None:
    """The file with the boxes of a drive; None if there is none."""
    return next(iter(sorted((root / "data_3d_bboxes").glob(f"*/{drive}.xml"))), None)


def labels_folder(root: Path, drive: str) -> Path:
    """The folder of a drive's labels per scan."""
    return root / LABELLED / drive / "labels"


def confidence_path(root: Path, drive: str, frame: str) -> Path:
    """The file with the confidence of a scan's labels."""
    return root / LABELLED / drive / "confidence" / f"{frame}.bin"


def label_file(root: Path, drive: str, frame: str) -> Path | None:
    """The label file of a scan; None if it has none."""
    paths = (
        labels_folder(root, drive) / f"{frame}{suffix}" for suffix in (".label", ".bin")
    )
    return next((path for path in paths if path.is_file()), None)


def read_scan_labels(
    root: Path, drive: str, frame: str, points: Path, count: int
) -> dict[str, Any]:
    """``label``, ``raw_label``, ``instance`` and, if known, ``confidence`` of a scan; empty if it
    has no label file.

    Raises:
        FileError: if its label file cannot be read.
        DataError: if the numbers of labels and points differ; on an id that KITTI-360 does not
            define.
    """
    path = label_file(root, drive, frame)
    if path is None:
        return {}
    content = read_file(path)
    if len(content) == 2 * count:
        ids = np.frombuffer(content, "<i2")
        raw = np.where(ids < 0, 0, ids).astype(np.uint32)
    elif len(content) == 4 * count:
        raw = np.frombuffer(content, "<u4")
    else:
        raise mismatch(path, len(content) // 4, points, count)
    found = decode_labels(raw, CLASSES, f"{path} (labels of {points})")
    trust = confidence_path(root, drive, frame)
    if trust.is_file():
        values = read_values(trust, "u1")
        if len(values) != count:
            raise mismatch(trust, len(values), points, count)
        found["confidence"] = values.astype(np.float32) / 255
    return found
