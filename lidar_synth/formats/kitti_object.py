"""KITTI 3D object detection: scans with boxes in the camera's view.

Layout (https://www.cvlibs.net/datasets/kitti/eval_object.php, devkit's readme)::

    training/velodyne/FFFFFF.bin         float32 x, y, z, reflectance; sensor frame
    training/velodyne_reduced/           the same, only points in the view of camera 2
    training/label_2/FFFFFF.txt          one object per line, rectified camera frame
    training/calib/FFFFFF.txt            P0..P3, R0_rect, Tr_velo_to_cam, Tr_imu_to_velo
    training/image_2/FFFFFF.png          left colour camera; also read as .jpg
    testing/                             the same without label_2
    ImageSets/train.txt, val.txt ...     frame numbers of each split
    mapping/train_mapping.txt, train_rand.txt    the drive of each frame, from the devkit
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from lidar_synth.errors import ConfigError, DataError, choose, parsing
from lidar_synth.files.disk import (
    list_files,
    name_errors,
    read_named_matrices,
    read_text,
    write_file,
)
from lidar_synth.files.parsing import picture_size
from lidar_synth.formats.calibration import (
    Calibration,
    homogeneous,
    ideal_camera,
    write_kitti_camera,
)
from lidar_synth.formats.camera_boxes import IMAGE_SIZE, CameraBoxes, assumed_size
from lidar_synth.formats.kitti_labels import in_image, read_label_2, write_label_2
from lidar_synth.formats.points import check_scale, read_points
from lidar_synth.formats.source import OnBad
from lidar_synth.formats.writer import Picture, Writer, write_image
from lidar_synth.geometry import Scan, Sensor

Part = Literal["training", "testing"]

SPLITS: dict[str, tuple[Part, ...]] = {
    "train": ("training",),
    "val": ("training",),
    "trainval": ("training",),
    "test": ("testing",),
    "all": ("training", "testing"),
}
"""{split: folders}; ``ImageSets`` lists the frames."""

OBJECT_CAMERA = ideal_camera(721.5377, IMAGE_SIZE)
"""The camera that is written if none is known: KITTI's image size and focal length, at the
sensor."""


class KITTIObject(CameraBoxes):
    """KITTI's object set: <root>/training and testing with velodyne, label_2, calib, image_2, and
    ImageSets.

    Args:
        root: the folder that holds ``training`` and ``testing``.
        split: ``train``, ``val``, ``trainval``, ``test`` (as listed in ``ImageSets/<split>.txt``)
            or ``all``. Without ``ImageSets``, ``trainval`` is all of ``training`` and ``test`` all
            of ``testing``.
        reduced: read ``velodyne_reduced``, the points in the view of camera 2.
        sensor: a preset's name, a YAML file or a ``Sensor``; by default what the folder says
            (``scans.json``), or else ``hdl64e_kitti``.
        reflectance_max: maximum of the reflectance in the files, by default 1; values are divided
            by it.
        on_bad: see ``ScanFiles``.

    Raises:
        ConfigError: on a split that KITTI does not have, or ``train`` or ``val`` without
            ``ImageSets``; on an invalid ``reflectance_max``.
        DataError: if the folder has none of the split's scans.

    Example:
        >>> from lidar_synth import KITTIObject
        >>> scans = KITTIObject("KITTI", split="trainval")
        >>> scans.ids[0]
        'training/000000'
        >>> boxes = scans[0].boxes
        >>> boxes.names[0], boxes.values.shape[1], boxes.image_box.shape[1]
        ('Car', 7, 4)
    """

    default_sensor = "hdl64e_kitti"

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        return any(root.glob("t[er]*ing/velodyne*"))

    def __init__(
        self,
        root: str | Path,
        split: str = "all",
        *,
        reduced: bool = False,
        sensor: str | Path | Sensor | None = None,
        reflectance_max: float | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        self._reflectance_max = check_scale(reflectance_max)
        root = Path(root)
        self._velodyne = "velodyne_reduced" if reduced else "velodyne"
        parts = choose("KITTI object split", split, SPLITS)
        image_set = root / "ImageSets" / f"{split}.txt"
        if split != "all" and image_set.is_file():
            ids = [f"{parts[0]}/{frame}" for frame in _read_frames(image_set)]
        elif split in ("train", "val"):
            raise ConfigError(
                f"split {split!r}, but there is no {image_set}",
                "the list of its frames",
                "Copy KITTI's ImageSets there, or use split='trainval', all of training.",
            )
        else:
            ids = [
                f"{part}/{path.stem}"
                for part in parts
                if (folder := root / part / self._velodyne).is_dir()
                for path in list_files(folder, ".bin")
            ]
        super().__init__(root, ids, sensor, on_bad)
        self.options["velodyne"] = self._velodyne

    @property
    def beyond_view(self) -> bool:
        """See ``CameraBoxes.beyond_view``."""
        return super().beyond_view and self._velodyne == "velodyne"

    def _has_boxes(self, name: str) -> bool:
        return self._file(name, "label_2", ".txt").is_file()

    @property
    def drives(self) -> tuple[str, ...] | None:
        """The drive of each scan, by the devkit's ``mapping`` beside ``training``; None without it:
        the frames' numbers are shuffled and do not tell.

        Raises:
            DataError: if the files of ``mapping`` do not fit together.
        """
        folder = self.root / "mapping"
        if not folder.is_dir():
            return None
        order = read_text(folder / "train_rand.txt").replace(",", " ").split()
        rows = read_text(folder / "train_mapping.txt").splitlines()
        with parsing(folder, "train_rand.txt and train_mapping.txt of the devkit"):
            found = {
                f"training/{frame:06d}": rows[int(line) - 1].split()[1]
                for frame, line in enumerate(order)
            }
        return tuple(found.get(name, name.partition("/")[0]) for name in self.ids)

    def _file(self, name: str, folder: str, suffix: str) -> Path:
        part, frame = name.split("/")
        return self.root / part / folder / f"{frame}{suffix}"

    def _image(self, name: str) -> Path:
        png = self._file(name, "image_2", ".png")
        return png if png.is_file() else png.with_suffix(".jpg")

    def read(self, index: int) -> Scan:
        name = self.ids[index]
        points = read_points(
            self._file(name, self._velodyne, ".bin"),
            reflectance_max=self._reflectance_max,
        )
        labels = self._file(name, "label_2", ".txt")
        image = self._image(name)
        boxes = None
        if labels.is_file():
            boxes = read_label_2(
                labels, read_calibration(self._file(name, "calib", ".txt"))
            )
        scan = Scan(
            points[:, :3],
            points[:, 3],
            self.sensor,
            boxes=boxes,
            image_path=image if image.is_file() else None,
            id=name,
        )
        return self._in_view(scan, index)

    def calibration(self, index: int) -> Calibration | None:
        name = self.ids[index]
        path = self._file(name, "calib", ".txt")
        if not path.is_file():
            return None
        return read_calibration(path, picture_size(self._image(name)))


class KITTIObjectWriter(Writer):
    """Writes the object set's folders: velodyne, label_2, calib, image_2 and, at the end,
    ImageSets.

    As in KITTI, ``label_2`` lists only boxes in the camera's view: those with a known
    ``image_box``, and those that reach into the image, for which ``image_box`` and truncation are
    computed. A scan without known boxes is refused for ``training``. Trainers read the image size
    from ``image_2``, so a scan without an image gets a black one.

    An id ``training/FFFFFF`` or ``testing/FFFFFF`` is kept; all other scans go into ``part``,
    numbered by index.

    Args:
        root: output folder.
        part: ``training`` or ``testing``.
        calibration: see ``Writer``.
    """

    keeps = frozenset({"boxes", "image_path"})

    def __init__(
        self,
        root: str | Path,
        *,
        part: Part = "training",
        calibration: Calibration | None = None,
    ) -> None:
        super().__init__(root, calibration=calibration)
        self.part = part
        if part == "testing":
            self.keeps -= {"boxes"}

    def _place(self, index: int, name: str | None) -> str:
        match = re.fullmatch(r"(training|testing)/0*([0-9]{1,10})", name or "")
        part, frame = (match[1], int(match[2])) if match else (self.part, index)
        return f"{part}/velodyne/{frame:06d}.bin"

    def _put(
        self,
        scan: Scan,
        path: Path,
        picture: Picture | None,
        camera: Calibration | None,
    ) -> None:
        folder = path.parents[1]
        frame = path.stem
        if folder.name == "training" and scan.boxes is None:
            raise DataError(
                f"scan {scan.id!r} has no boxes",
                "a scan whose boxes are known: an empty label_2 would mean that there is no object",
                "Write it as semantic_kitti, or without label_2: KITTIObjectWriter(root, "
                "part='testing').",
            )
        camera = camera or OBJECT_CAMERA
        if picture is None:
            width, height = assumed_size(camera)
            picture = np.zeros((height, width, 3), np.uint8)
        if camera.image_size is None:  # on which depends which boxes are in view
            size = (
                picture_size(picture)
                if isinstance(picture, Path)
                else picture.shape[1::-1]
            )
            camera = replace(camera, image_size=size)
        if folder.name == "training" and scan.boxes is not None:
            write_label_2(folder / "label_2" / f"{frame}.txt", scan.boxes, camera)
        write_image(folder / "image_2" / f"{frame}.png", picture)
        write_kitti_camera(
            folder / "calib" / f"{frame}.txt",
            camera,
            {
                "R0_rect": np.eye(3),
                "Tr_velo_to_cam": camera.camera_from_sensor[:3],
                "Tr_imu_to_velo": np.eye(4)[:3],
            },
        )
        self._write_points(path, scan)

    def loses(self, scan: Scan, camera: Calibration | None) -> list[str]:
        lost = super().loses(scan, camera)
        if scan.boxes is None or "boxes" in lost:
            return lost
        camera = camera or self.calibration or OBJECT_CAMERA
        camera = replace(camera, image_size=assumed_size(camera))
        if (in_image(scan.boxes, camera)[0] < 0).any():
            lost.append("boxes outside the camera's view")
        return lost

    def finish(self) -> None:
        parts = {"train": "training", "trainval": "training", "test": "testing"}
        for split, part in parts.items():
            folder = self.root / part / "velodyne"
            if folder.is_dir():
                frames = [p.stem for p in list_files(folder, ".bin")]
                write_file(
                    self.root / "ImageSets" / f"{split}.txt",
                    "".join(f"{f}\n" for f in frames).encode(),
                )


def _read_frames(image_set: Path) -> list[str]:
    frames = read_text(image_set).split()
    if bad := [frame for frame in frames if not re.fullmatch(r"\w[\w.-]*", frame)]:
        raise DataError(
            f"{image_set} lists {bad[0][:100]!r}", "names of frames, such as 000123"
        )
    return frames


def read_calibration(
    path: Path, image_size: tuple[int, int] | None = None
) -> Calibration:
    """Camera 2 of a ``calib`` file.

    Raises:
        FileError: if it cannot be read.
        DataError: if P2, R0_rect or Tr_velo_to_cam is missing or invalid.
    """
    matrices = read_named_matrices(path)
    sizes = {
        name: matrices.get(name, np.zeros(0)).size
        for name in ("P2", "R0_rect", "Tr_velo_to_cam")
    }
    if sizes != {"P2": 12, "R0_rect": 9, "Tr_velo_to_cam": 12}:
        raise DataError(
            f"{path} has {sizes} values",
            "P2 with 12, R0_rect with 9 and Tr_velo_to_cam with 12",
        )
    camera_from_sensor = homogeneous(matrices["R0_rect"]) @ homogeneous(
        matrices["Tr_velo_to_cam"]
    )
    with name_errors(path):
        return Calibration(
            matrices["P2"].reshape(3, 4), camera_from_sensor, image_size, matrices
        )
