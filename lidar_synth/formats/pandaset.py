"""PandaSet: drives of a Pandar64 and a forward PandarGT with labels, boxes, poses and six cameras.

Layout (https://github.com/scaleapi/pandaset-devkit), a folder for each sequence::

    NNN/lidar/FF.pkl.gz                 table x, y, z (world, metres), i 0..255, t (seconds),
                                        d (0 Pandar64, 1 GT)
    NNN/lidar/poses.json                for each frame position and heading (w, x, y, z): vehicle to
                                        world
    NNN/lidar/timestamps.json           seconds, one for each frame
    NNN/annotations/semseg/FF.pkl.gz    table class, a row for each point; not for every sequence
    NNN/annotations/cuboids/FF.pkl.gz   table of boxes in the world frame
    NNN/camera/NAME/FF.jpg              six cameras, with poses.json, timestamps.json,
                                        intrinsics.json

The tables are pickled by pandas; ``pandas_table`` reads them without running their code. The points
are compensated for the motion of the vehicle: each is in the world frame. By default the reader
undoes this, because only then do points lie on the sensor's beams: every point is given in the
frame of the sensor at the time of its own measurement. The package reads this layout and does not
write it.

The data are licensed under CC BY 4.0 with PandaSet's Dataset Terms: name Scale AI and Hesai in what
you publish.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import PANDASET
from lidar_synth.errors import DataError, choose
from lidar_synth.files.disk import list_files, name_errors
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.pandas_table import read_table, require_numbers
from lidar_synth.formats.pandaset_cuboids import read_cuboids
from lidar_synth.formats.pandaset_tracks import (
    FORWARD,
    MOUNTS,
    Track,
    read_intrinsics,
    read_track,
)
from lidar_synth.formats.point_labels import mismatch
from lidar_synth.formats.points import check_points
from lidar_synth.formats.source import OnBad, ScanFiles
from lidar_synth.geometry import Boxes, Scan, Sensor
from lidar_synth.geometry.motion import from_world, interpolate_poses

FRAMES = "lidar/*.pkl.gz"
SUFFIX = ".pkl.gz"
INTENSITY_MAX = 255.0
VIEW = np.radians(32)
"""The forward sensor sees objects up to this angle to the left and to the right."""
IMAGE_SIZE = (1920, 1080)
CAMERAS = (
    "front_camera",
    "front_left_camera",
    "front_right_camera",
    "left_camera",
    "right_camera",
    "back_camera",
)


class PandaSet(ScanFiles):
    """PandaSet's sequences: <root>/NNN/lidar/*.pkl.gz with poses.json and timestamps.json,
    annotations and cameras.

    A scan has labels if its sequence has them, boxes, and in ``time`` the seconds between its
    timestamp and each point. ``pose`` is the pose of the sensor at the timestamp. Points of the
    Pandar64 have rings, of the nearest beam.

    Args:
        root: the folder of the sequences, or one sequence.
        sensor: ``pandar64`` (the default) or ``pandar_gt``, the forward sensor; a YAML file or a
            ``Sensor`` describes a Pandar64 unless it is named ``pandar_gt``.
        motion_compensated: whether all points are in the frame of the sensor at the scan's
            timestamp, as in KITTI's odometry; by default each is in the frame of the sensor at its
            own time, as it was measured.
        sequences: names of the sequences to read, such as ``("002",)``; all by default. PandaSet
            has no splits.
        camera: the camera of ``image_path`` and of the calibration, one of ``CAMERAS``.
        on_bad: see ``ScanFiles``.

    Raises:
        ConfigError: on an unknown camera.
        DataError: if the folder has none of the sequences.

    Example:
        >>> from lidar_synth import PandaSet
        >>> scans = PandaSet("PandaSet")
        >>> scans.ids[0], scans.sensor.name
        ('007/00', 'pandar64')
        >>> list(scans[0].fields())
        ['reflectance', 'label', 'raw_label', 'ring', 'time']
    """

    default_sensor = "pandar64"

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        return any(any(root.glob(p)) for p in (FRAMES, f"*/{FRAMES}"))

    def __init__(
        self,
        root: str | Path,
        *,
        sensor: str | Path | Sensor | None = None,
        motion_compensated: bool = False,
        sequences: Sequence[str] | None = None,
        camera: str = CAMERAS[0],
        on_bad: OnBad = "error",
    ) -> None:
        choose("PandaSet's camera", camera, dict.fromkeys(CAMERAS))
        root = Path(root)
        if sequences is None and any(root.glob(FRAMES)):
            root, sequences = root.resolve().parent, (root.resolve().name,)
        existing = sorted({path.parents[1].name for path in root.glob(f"*/{FRAMES}")})
        wanted = existing if sequences is None else list(sequences)
        if missing := [name for name in wanted if name not in existing]:
            raise DataError(
                f"{root} has no sequence {', '.join(missing)}",
                f"some of {', '.join(existing) or 'none'}",
            )
        frames = [
            (name, path)
            for name in wanted
            for path in list_files(root / name / "lidar", SUFFIX)
        ]
        super().__init__(
            root,
            [f"{name}/{path.name.removesuffix(SUFFIX)}" for name, path in frames],
            sensor,
            on_bad,
        )
        self.camera = camera
        self.motion_compensated = motion_compensated
        if camera != CAMERAS[0]:
            self.options["camera"] = camera
        if motion_compensated:
            self.options["motion_compensated"] = True
        self._device = int(self.sensor.name == FORWARD)
        self._mount = MOUNTS[FORWARD if self._device else "pandar64"]
        self._tracks: dict[Path, Track] = {}

    def read(self, index: int) -> Scan:
        folder, frame = self._place(index)
        path = folder / "lidar" / f"{frame}{SUFFIX}"
        track = self._track(folder / "lidar")
        number = track.number(frame, path)
        table = read_table(path, "xyzitd")
        require_numbers(table, "xyzitd", path)
        kept = table["d"] == self._device
        world = np.stack([table[axis][kept] for axis in "xyz"], axis=-1).astype(
            np.float64
        )
        time = table["t"][kept].astype(np.float64)
        pose = track.poses[number] @ self._mount
        with name_errors(path):
            measured = from_world(
                world, interpolate_poses(track.times, track.poses, time) @ self._mount
            )
        points = (
            from_world(world, pose) if self.motion_compensated else measured
        ).astype(np.float32)
        intensity = table["i"][kept].astype(np.float32)
        check_points(points, intensity, str(path), INTENSITY_MAX)
        image = folder / "camera" / self.camera / f"{frame}.jpg"
        return Scan(
            points,
            intensity / np.float32(INTENSITY_MAX),
            self.sensor,
            **self._labels(folder, frame, path, kept),
            ring=None if self._device else _rings(measured, self.sensor),
            time=(time - track.times[number]).astype(np.float32),
            boxes=self._boxes(folder / "annotations" / "cuboids" / path.name, pose),
            pose=pose,
            image_path=image if image.is_file() else None,
            id=self.ids[index],
        )

    def calibration(self, index: int) -> Calibration | None:
        """The camera relative to the sensor.

        A rotating sensor passes a camera's view when the camera takes its image. Points as measured
        are therefore projected from the sensor at the time of the image, and compensated ones from
        the sensor at the timestamp.
        """
        folder, frame = self._place(index)
        source = folder / "camera" / self.camera
        if not (source / "intrinsics.json").is_file():
            return None
        track = self._track(folder / "lidar")
        camera = self._track(source)
        number = camera.number(frame, source)
        when = (
            track.times[track.number(frame, source)]
            if self.motion_compensated
            else camera.times[number]
        )
        with name_errors(source / "intrinsics.json"):
            pose = (
                interpolate_poses(track.times, track.poses, np.array([when]))[0]
                @ self._mount
            )
            projection = read_intrinsics(source)
            return Calibration(
                projection, np.linalg.inv(camera.poses[number]) @ pose, IMAGE_SIZE
            )

    def _place(self, index: int) -> tuple[Path, str]:
        """Folder of the sequence and name of the frame of a scan."""
        sequence, frame = self.ids[index].split("/")
        return self.root / sequence, frame

    def _track(self, folder: Path) -> Track:
        if folder not in self._tracks:
            self._tracks[folder] = read_track(folder)
        return self._tracks[folder]

    def _labels(
        self, folder: Path, frame: str, points: Path, kept: NDArray[np.bool_]
    ) -> dict[str, Any]:
        """The labels of one sensor's points, as arguments of ``Scan``."""
        path = folder / "annotations" / "semseg" / f"{frame}{SUFFIX}"
        if not path.parent.is_dir():
            return {}
        table = read_table(path, ["class"])
        require_numbers(table, ["class"], path, "iu")
        raw = table["class"]
        if len(raw) != len(kept):
            raise mismatch(path, len(raw), points, len(kept))
        return {
            "label": PANDASET.decode(raw[kept], str(path)),
            "raw_label": raw[kept].astype(np.uint32),
        }

    def _boxes(self, path: Path, pose: NDArray[np.float64]) -> Boxes | None:
        if not path.is_file():
            return None
        with name_errors(path):
            boxes = read_cuboids(path, pose, other_sensor=1 - self._device)
        ahead = abs(np.arctan2(boxes.values[:, 1], boxes.values[:, 0])) < VIEW
        return boxes[ahead] if self._device else boxes


def _rings(points: NDArray[np.float64], sensor: Sensor) -> NDArray[np.int16]:
    """(N,) row of the beam whose elevation is nearest, for points as measured."""
    with np.errstate(invalid="ignore"):
        elevation = np.arctan2(points[:, 2], np.linalg.norm(points[:, :2], axis=1))
    beams = sensor.laser_elevations.astype(np.float64)
    between = (beams[1:] + beams[:-1]) / 2
    below: NDArray[np.int64] = np.searchsorted(between[::-1], elevation)
    return (len(between) - below).astype(np.int16)
