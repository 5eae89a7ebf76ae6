"""SemanticKITTI: KITTI's odometry scans with a class and an instance for every point.

Layout (http://www.semantic-kitti.org/dataset.html)::

    sequences/NN/velodyne/FFFFFF.bin    float32 x, y, z, reflectance; sensor frame
    sequences/NN/labels/FFFFFF.label    uint32 per point: class below, instance in the upper 16 bits
    sequences/NN/image_2/FFFFFF.png     left colour camera
    sequences/NN/calib.txt              P0..P3 and Tr: rectified camera 0 from velodyne
    sequences/NN/poses.txt              line F: camera 0 at frame F to world, 12 numbers
    sequences/NN/times.txt              line F: seconds

The pose of a ``Scan`` is sensor to world: Tr^-1 pose Tr.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import SEMANTIC_KITTI, Taxonomy
from lidar_synth.errors import DataError, choose
from lidar_synth.files.disk import (
    hash_of_names,
    list_files,
    name_errors,
    numbers,
    read_file,
    read_matrix,
    read_named_matrices,
    read_text,
    write_file,
)
from lidar_synth.files.parsing import picture_size
from lidar_synth.formats.calibration import (
    Calibration,
    check_rigid,
    homogeneous,
    ideal_camera,
    write_kitti_camera,
)
from lidar_synth.formats.point_labels import encode_labels, read_labels, write_labels
from lidar_synth.formats.points import check_scale, read_points
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
from lidar_synth.geometry import Scan, Sensor

SPLITS: dict[str, tuple[str, ...] | None] = {
    "train": tuple(f"{i:02d}" for i in (0, 1, 2, 3, 4, 5, 6, 7, 9, 10)),
    "val": ("08",),
    "test": tuple(f"{i:02d}" for i in range(11, 22)),
    "all": None,
}
"""Sequences of each split of the benchmark; None = all existing sequences."""

KITTI_CAMERA = ideal_camera(718.856, (1241, 376))
"""The camera that is written if none is known: the odometry camera's image size and focal length,
at the sensor."""

SIDE_FILES = ("calib.txt", "poses.txt", "times.txt")
"""Files of a sequence besides its scans."""


class SemanticKITTI(ScanFiles):
    """SemanticKITTI's sequences: <root>/sequences/NN/velodyne/*.bin with labels, calib.txt,
    poses.txt, image_2.

    ``raw_label`` keeps the uint32 values of the file, with moving classes and instances. The scans
    of a sequence without a ``labels`` folder (the test set) have no labels.

    Args:
        root: the folder that holds ``sequences``, that folder itself, or one sequence.
        split: ``train``, ``val``, ``test`` or ``all``.
        sensor: a preset's name, a YAML file or a ``Sensor``; by default what the folder says
            (``scans.json``), or else ``hdl64e_semantic_kitti``.
        taxonomy: the class ids of the labels, for datasets in this layout with classes of their
            own.
        reflectance_max: maximum of the reflectance in the files, by default 1; values are divided
            by it.
        on_bad: see ``ScanFiles``.

    Raises:
        ConfigError: on a split that SemanticKITTI does not have, or an invalid
            ``reflectance_max``.
        DataError: if the folder has none of the split's sequences.

    Example:
        >>> from lidar_synth import SemanticKITTI
        >>> scans = SemanticKITTI("demo_out/town", split="train")
        >>> scans.ids[0], scans[0].pose.shape
        ('00/000000', (4, 4))
        >>> list(scans[0].fields())
        ['reflectance', 'label', 'raw_label', 'instance']
    """

    default_sensor = "hdl64e_semantic_kitti"

    @classmethod
    def recognises(cls, root: Path) -> bool:
        """See ``ScanFiles.recognises``."""
        patterns = ("labels/*.label", "calib.txt")
        found = (p.parent for to in ("velodyne", "*/velodyne") for p in root.glob(to))
        return any(root.glob("sequences/*/velodyne")) or any(
            any(folder.glob(pattern)) for folder in found for pattern in patterns
        )

    def __init__(
        self,
        root: str | Path,
        split: str = "all",
        *,
        sensor: str | Path | Sensor | None = None,
        taxonomy: Taxonomy = SEMANTIC_KITTI,
        reflectance_max: float | None = None,
        on_bad: OnBad = "error",
    ) -> None:
        self._reflectance_max = check_scale(reflectance_max)
        root = Path(root)
        self.taxonomy = taxonomy
        self.folders = folders = _find_sequences(root, split)
        ids = [
            f"{s}/{p.stem}"
            for s, folder in folders.items()
            for p in list_files(folder / "velodyne", ".bin")
        ]
        super().__init__(root, ids, sensor, on_bad)
        if taxonomy != SEMANTIC_KITTI:
            table = hash_of_names(map(str, sorted(taxonomy.to_train.items())))
            self.options["taxonomy"] = [taxonomy.name, table]
        self._labelled = {s for s, f in folders.items() if (f / "labels").is_dir()}
        self._cameras = {s: read_calibration(f) for s, f in folders.items()}
        self._poses = {s: read_poses(f, self._cameras[s]) for s, f in folders.items()}

    def read(self, index: int) -> Scan:
        sequence, frame = self.ids[index].split("/")
        folder = self.folders[sequence]
        path = folder / "velodyne" / f"{frame}.bin"
        points = read_points(path, reflectance_max=self._reflectance_max)
        labels = {}
        if sequence in self._labelled:
            labels = read_labels(
                folder / "labels" / f"{frame}.label", path, len(points), self.taxonomy
            )
        image = folder / "image_2" / f"{frame}.png"
        return Scan(
            points[:, :3],
            points[:, 3],
            self.sensor,
            **labels,
            pose=self._poses[sequence].get(int(frame)) if frame.isdecimal() else None,
            image_path=image if image.is_file() else None,
            id=self.ids[index],
        )

    def calibration(self, index: int) -> Calibration | None:
        return self._cameras[self.ids[index].split("/")[0]]


class SemanticKITTIWriter(Writer):
    """Writes SemanticKITTI's folders, always with labels; unlabelled points and ignored classes are
    0.

    Sequence and frame of an id ``NN/FFFFFF`` are kept, and those of KITTI-360's drives (drive 0003
    is sequence 03); all other scans go into ``sequence``, numbered by index. ``poses.txt`` has one
    line for every frame up to the last, with ``nan`` for unknown poses. ``times.txt`` is not
    written, because a scan has no time. ``carry`` copies the existing ones of these three files
    from sequences of SemanticKITTI.

    Args:
        root: output folder.
        sequence: sequence of scans without one of their own.
        calibration: see ``Writer``.
    """

    keeps = LABELS | {"pose", "image_path"}
    always_labels = True

    def __init__(
        self,
        root: str | Path,
        *,
        sequence: str = "00",
        calibration: Calibration | None = None,
    ) -> None:
        super().__init__(root, calibration=calibration)
        self.sequence = sequence
        self._carried: set[str] = set()

    def _place(self, index: int, name: str | None) -> str:
        # Six digits, as the dataset has: poses.txt has a line for every frame up to the last.
        kept = drive_and_frame(name, 6)
        sequence, frame = kept or (self.sequence, index)
        return f"sequences/{sequence}/velodyne/{frame:06d}.bin"

    def _put(
        self,
        scan: Scan,
        path: Path,
        picture: Picture | None,
        camera: Calibration | None,
    ) -> None:
        folder = path.parents[1]
        frame = path.stem
        if folder.name not in self._carried:
            if not (folder / "calib.txt").is_file():
                known = camera or KITTI_CAMERA
                transform = {"Tr": known.camera_from_sensor[:3]}
                write_kitti_camera(folder / "calib.txt", known, transform)
            write_note(folder, int(frame), {"pose": scan.pose})
        if picture is not None:
            write_image(folder / "image_2" / f"{frame}.png", picture)
        write_labels(
            folder / "labels" / f"{frame}.label", encode_labels(scan, SEMANTIC_KITTI)
        )
        self._write_points(path, scan)

    def carry(self, source: ScanFiles) -> list[str]:
        if not isinstance(source, SemanticKITTI):
            return ["times.txt: the times of the scans are unknown"]
        missing = []
        for sequence in sorted({name.split("/")[0] for name in source.ids}):
            names = [n for n in source.ids if n.startswith(f"{sequence}/")]
            if not all((drive_and_frame(n, 6) or [""])[0] == sequence for n in names):
                missing.append(
                    f"calibration, poses and times of sequence {sequence}: its scans are renumbered"
                )
                continue
            self._carried.add(sequence)
            for name in SIDE_FILES:
                path = source.folders[sequence] / name
                if path.is_file():
                    write_file(
                        self.root / "sequences" / sequence / name, read_file(path)
                    )
                else:
                    missing.append(
                        f"sequences/{sequence}/{name}: {source.root} has none"
                    )
        return missing

    def finish(self) -> None:
        for folder in sorted((self.root / "sequences").glob("*")):
            notes, poses = read_notes(folder)
            camera = read_calibration(folder)
            if notes and camera is not None:
                write_poses(folder, camera, poses, frames=1 + max(notes))
            clear_notes(folder)


def _find_sequences(root: Path, split: str) -> dict[str, Path]:
    """The folders of a split's sequences by their numbers, in order."""
    wanted = choose("SemanticKITTI split", split, SPLITS)
    patterns = ("sequences/*/velodyne", "*/velodyne", "velodyne")
    paths = next(filter(None, (sorted(root.glob(p)) for p in patterns)), [])
    existing = {p.parent.absolute().name: p.parent for p in paths}
    found = {s: f for s, f in existing.items() if wanted is None or s in wanted}
    if not found:
        raise DataError(
            f"{root} has no sequence of split {split!r} (it has "
            f"{', '.join(existing) or 'none at all'})",
            "sequences/NN/velodyne/*.bin",
        )
    return found


def read_calibration(folder: Path) -> Calibration | None:
    """Camera 2 of a sequence; None without ``calib.txt`` or its lines ``P2`` and ``Tr``."""
    if not (folder / "calib.txt").is_file():
        return None
    matrices = read_named_matrices(folder / "calib.txt")
    if any(matrices.get(name, np.zeros(0)).size != 12 for name in ("P2", "Tr")):
        return None
    size = next(
        (picture_size(p) for p in sorted((folder / "image_2").glob("*.png"))), None
    )
    with name_errors(folder / "calib.txt"):
        return Calibration(
            matrices["P2"].reshape(3, 4), homogeneous(matrices["Tr"]), size, matrices
        )


def read_poses(
    folder: Path, camera: Calibration | None
) -> dict[int, NDArray[np.float64]]:
    """{frame: (4, 4) sensor to world}; empty without ``poses.txt`` or a calibration. A line of
    ``nan`` is a frame without a pose.

    Raises:
        DataError: on a line without 12 numbers, or a pose that is not rigid.
    """
    if camera is None or not (folder / "poses.txt").is_file():
        return {}
    lines = read_matrix(folder / "poses.txt", 12)
    matrices = np.tile(np.eye(4), (len(lines), 1, 1))
    matrices[:, :3] = lines.reshape(-1, 3, 4)
    known = np.flatnonzero(~np.isnan(lines).all(axis=1))
    check_rigid(matrices[known], str(folder / "poses.txt"))
    poses = camera.sensor_from_camera @ matrices[known] @ camera.camera_from_sensor
    return dict(zip(known.tolist(), poses, strict=True))


def write_poses(
    folder: Path,
    camera: Calibration,
    poses: dict[int, NDArray[np.float64]],
    frames: int,
) -> None:
    """The inverse of ``read_poses``, for at least this number of frames; writes nothing if no pose
    is known.

    Poses of other frames in the file stay as they are, since reading a pose rounds it.
    """
    path = folder / "poses.txt"
    lines = read_text(path).splitlines() if path.is_file() else []
    if not poses and not lines:
        return
    unknown = numbers(np.full(12, np.nan))
    lines += [unknown] * (frames - len(lines))
    for frame, pose in poses.items():
        line = (camera.camera_from_sensor @ pose @ camera.sensor_from_camera)[:3]
        lines[frame] = numbers(line.ravel())
    write_file(path, "".join(line + "\n" for line in lines).encode())
