"""``Writer``, the base class of all writers: paths of scans, complete scans, and files of the whole
folder.

``write`` writes the files of one scan, and last the file that marks it as complete. Scans can
therefore be written in any order and by several processes, and an interrupted run can be resumed.
Data for files of the whole folder (poses, boxes, lists of frames) are noted beside each scan and
gathered by ``finish``, which one process calls at the end.
"""

import json
import re
import shutil
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError, parsing
from lidar_synth.files.claims import hold_claim, require_outside
from lidar_synth.files.disk import (
    join_inside,
    list_files,
    read_file,
    read_text,
    refuse_links,
    write_file,
)
from lidar_synth.files.parsing import parse_json, read_rgb
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.description import (
    NAME,
    Description,
    Origin,
    check_provenance,
    read_description,
    record,
    require_grid,
)
from lidar_synth.formats.npz import check_pose
from lidar_synth.formats.points import check_scan, write_points
from lidar_synth.formats.source import ScanFiles
from lidar_synth.geometry import POINT_FIELDS, REAL, SYNTHETIC, RangeImage, Scan
from lidar_synth.geometry.projection import project

Image = NDArray[np.uint8]
Picture = Image | Path
"""An image as an array, (H, W, 3) RGB, or as the path of a file."""

LABELS = frozenset({"label", "raw_label", "instance"})
"""The fields of a scan that KITTI's label files hold."""

DETAILS = (*POINT_FIELDS[1:], "boxes", "pose", "image_path")
"""What a scan may have besides points and reflectance."""

NOTES = ".lidar_synth"
"""Folder of the notes that ``finish`` gathers and then removes."""


class Writer(ABC):
    """Writes scans into one output folder.

    Args:
        root: the folder; it is created.
        calibration: the camera, for layouts with a calibration; by default an ideal camera at the
            sensor that faces forward.

    Attributes:
        keeps: those of ``DETAILS`` that the layout can hold.
        always_labels: whether it has labels of every scan, 0 (unlabelled) where they are unknown.
    """

    keeps: frozenset[str]
    always_labels = False

    def __init__(
        self, root: str | Path, *, calibration: Calibration | None = None
    ) -> None:
        self.root = Path(root)
        self.calibration = calibration
        self._without_links = False
        self._description: Description | None = None

    @property
    def _base(self) -> Path:
        """The folder, under ``root``, to which ``_place`` is relative."""
        return self.root

    def path(self, index: int, name: str | None = None) -> Path:
        """The file whose presence marks a scan as complete; always under ``root``.

        Args:
            index: the scan's index in the source.
            name: its id in the source; a layout keeps its parts as far as it can (frame number,
                drive) and otherwise uses the index.

        Raises:
            DataError: on a name that cannot be a path under ``root``.
            FileError: if a link in ``root`` leads out of it.
        """
        if not self._without_links:
            refuse_links(self.root)
            self._without_links = True
        return join_inside(self._base, self._place(index, name))

    @abstractmethod
    def _place(self, index: int, name: str | None) -> str:
        """The path of a scan relative to ``_base``, with / as separator."""

    def write(
        self,
        scan: Scan,
        index: int,
        *,
        name: str | None = None,
        image: Image | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        """Write one scan completely.

        Args:
            scan: the scan.
            index, name: as for ``path``.
            image: (H, W, 3) uint8 RGB image of the scan; by default ``scan.image_path`` is copied.
            calibration: the camera of this scan; by default the writer's.

        Raises:
            ConfigError: if the folder holds scans on another grid.
            FileError: if the folder cannot be written or the disk is full.
            DataError: on a scan that a reader would refuse, or that the layout cannot represent.
        """
        if self._description is None and (self.root / NAME).is_file():
            self._description = read_description(self.root)
        if self._description is not None:
            require_grid(self.root, self._description, scan.sensor)
        where = f"scan {scan.id!r}"
        check_facts(scan, where)
        scan = replace(scan)  # checks fields that were set since it was made, too
        check_scan(scan, where)
        picture = scan.image_path if image is None else image
        self._put(
            scan, self.path(index, name), picture, calibration or self.calibration
        )

    def hold(
        self, note: str, settings: dict[str, Any], source: object = None
    ) -> AbstractContextManager[None]:
        """Claim the folder by its file ``note``, as ``hold_claim`` does.

        Raises:
            ConfigError: also if this folder is the source's, or lies in one whose folders are all
                read, or if it is claimed for the first time and holds files like those of scans.
        """
        if isinstance(source, ScanFiles) and (
            source.plain or self.root.resolve() == Path(source.root).resolve()
        ):
            require_outside(self.root, source.root)
        path = self.root / note
        there = self.root.rglob(f"*{self.path(0).suffix}")
        if not path.is_file() and (scan := next(there, None)):
            raise ConfigError(
                f"{self.root} holds files that this command did not write, such as {scan}",
                "a new or an empty folder",
            )
        return hold_claim(path, settings)

    def _write_points(self, path: Path, scan: Scan) -> None:
        """Write the points of a scan as ``.bin``, which has no room for a description: it is
        recorded beside them."""
        origin = Origin.of(scan)
        if self._description is None or origin not in self._description.origins:
            self._description = record(self.root, scan.sensor, origin)
        write_points(path, scan)

    def loses(self, scan: Scan, camera: Calibration | None) -> list[str]:
        """What the scan has, but the layout cannot hold: names of ``DETAILS``, or words.

        Args:
            scan: the scan.
            camera: as ``calibration`` of ``write``.
        """
        return [
            name
            for name in DETAILS
            if name not in self.keeps and getattr(scan, name) is not None
        ]

    @abstractmethod
    def _put(
        self,
        scan: Scan,
        path: Path,
        picture: Picture | None,
        camera: Calibration | None,
    ) -> None:
        """Write the files of a scan, ``path`` last."""

    def complete(self, index: int, name: str | None = None) -> bool:
        """Whether the scan has already been written completely."""
        return self.path(index, name).is_file()

    def carry(self, source: ScanFiles) -> list[str]:
        """Copy a source's files that belong to no single scan, before its scans are written.

        Returns:
            Descriptions of the files that the layout supports but the source does not have; they
            are left out.

        Raises:
            FileError: if it cannot be read or written.
        """
        return []

    def finish(self) -> None:  # noqa: B027 - a layout of single files has nothing to gather
        """Write the files of the whole folder. Calling it again changes nothing."""


class FileWriter(Writer):
    """A writer of one file per scan, ``<name><suffix>`` under the output folder, without picture
    and camera."""

    suffix: str

    def _place(self, index: int, name: str | None) -> str:
        return f"{name or f'{index:06d}'}{self.suffix}"

    def _put(
        self,
        scan: Scan,
        path: Path,
        picture: Picture | None,
        camera: Calibration | None,
    ) -> None:
        self._write_file(path, scan)

    @abstractmethod
    def _write_file(self, path: Path, scan: Scan) -> None:
        """Write a scan."""


class GridWriter(FileWriter):
    """A writer of scans on their sensor's grid, which holds one point for each ray."""

    def loses(self, scan: Scan, camera: Calibration | None) -> list[str]:
        lost = super().loses(scan, camera)
        if project_scan(scan).mask.sum() < len(scan):
            lost.append("points without a cell of their own")
        return lost


def check_facts(scan: Scan, where: str) -> None:
    """Refuse a domain, provenance or pose that readers refuse.

    Raises:
        DataError: on one.
    """
    with parsing(where, "what files can hold"):
        check_provenance(dict(scan.provenance or {}))
        if scan.pose is not None:
            check_pose(scan.pose)
        if scan.domain not in (REAL, SYNTHETIC):
            raise ValueError(
                f"domain is {scan.domain}, not {REAL} (real) or {SYNTHETIC} (synthetic)"
            )


def project_scan(scan: Scan) -> RangeImage:
    """The scan on its sensor's grid.

    Raises:
        DataError: if none of its points lies on the grid.
    """
    image = project(scan)
    if not image.mask.any():
        given = f"scan {scan.id!r}: none of its {len(scan)} points"
        raise DataError(
            given, f"points in the view and range of sensor {scan.sensor.name!r}"
        )
    return image


def write_image(path: Path, picture: Picture) -> None:
    """Write a PNG from (H, W, 3) uint8 values or from another image file; a PNG is copied
    unchanged.

    Raises:
        FileError: if it cannot be read or written.
    """
    if isinstance(picture, Path) and picture.suffix.lower() == path.suffix:
        write_file(path, read_file(picture))
        return
    from PIL import Image as pillow

    opened = (
        read_rgb(picture) if isinstance(picture, Path) else pillow.fromarray(picture)
    )
    write_file(path, lambda file: opened.convert("RGB").save(file, "PNG"))


def drive_and_frame(name: str | None, digits: int) -> tuple[str, int] | None:
    """The drive of a scan, two digits, and its frame, by its id in SemanticKITTI (``NN/FFFFFF``) or
    KITTI-360; None if the id is another, or its frame has more digits."""
    start = "(?:2013_05_28_drive_00)?([0-9]{2})(?:_sync)?"
    match = re.fullmatch(f"{start}/0*([0-9]{{1,{digits}}})", name or "")
    return (match[1], int(match[2])) if match else None


def write_note(folder: Path, frame: int, facts: dict[str, Any]) -> None:
    """Note the facts of one frame for files of the whole folder (plain values and arrays; floats
    stay exact), among them its ``pose`` or None.

    Raises:
        FileError: if it cannot be written.
    """
    write_file(
        folder / NOTES / f"{frame:010d}.json",
        json.dumps(facts, default=np.ndarray.tolist).encode(),
    )


def read_notes(
    folder: Path,
) -> tuple[dict[int, dict[str, Any]], dict[int, NDArray[np.float64]]]:
    """{frame: facts} of the notes in a folder, and {frame: (4, 4)} their poses.

    Raises:
        DataError: on a damaged note.
    """
    notes = {}
    for path in (
        list_files(folder / NOTES, ".json") if (folder / NOTES).is_dir() else []
    ):
        expected = "a note of this package"
        hint = f"Remove {path.parent}."
        with parsing(path, expected, hint):
            notes[int(path.stem)] = parse_json(
                read_text(path), str(path), expected, hint
            )
    known = {f: note["pose"] for f, note in notes.items() if note["pose"] is not None}
    return notes, {frame: np.array(pose) for frame, pose in known.items()}


def clear_notes(folder: Path) -> None:
    """Remove the notes of a folder after they were gathered."""
    shutil.rmtree(folder / NOTES, ignore_errors=True)
