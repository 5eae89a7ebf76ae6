"""What all writers have in common: where a scan goes, whether it is already there, and the files of a whole folder.

A writer is opened on an output folder. ``write`` puts one scan there, its own files only, the one that says that
it is whole last; so scans can be written in any order, by several processes, and an interrupted run goes on where
it stopped. What belongs to a whole folder (poses, boxes, lists of frames) is noted beside each scan and gathered
by ``finish``, which one process calls at the end.
"""

import json
import shutil
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import inside, list_files, read_file, read_text, refuse_links, write_file
from lidar_synth.files.parsing import parse_json, read_picture
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.source import ScanFiles
from lidar_synth.geometry.scan import Scan

Image = NDArray[np.uint8]
Picture = Image | Path
"""An image by its values, (H, W, 3) RGB, or by its file."""

NOTES = ".lidar_synth"
"""Folder of the notes that ``finish`` gathers; it is gone afterwards."""


class Writer(ABC):
    """Writes scans into one output folder.

    Args:
        root: the folder; it is made.
        calibration: the camera beside the sensor, for the layouts that hold one; without it they describe an ideal
            camera that stands in the sensor and looks ahead.
    """

    def __init__(self, root: str | Path, *, calibration: Calibration | None = None) -> None:
        self.root = Path(root)
        self.calibration = calibration
        self._without_links = False

    @property
    def _base(self) -> Path:
        """The folder in which ``_place`` is; under ``root``."""
        return self.root

    def path(self, index: int, name: str | None = None) -> Path:
        """The file whose presence says that a scan is whole; always in ``root``, wherever the name comes from.

        Args:
            index: the scan's number in the source.
            name: its id there; a layout keeps what it can of it (frame number, drive) and otherwise counts.

        Raises:
            DataError: on a name that cannot be a file's under ``root``.
            FileError: where a link in ``root`` leads out of it.
        """
        if not self._without_links:
            refuse_links(self.root)
            self._without_links = True
        return inside(self._base, self._place(index, name))

    @abstractmethod
    def _place(self, index: int, name: str | None) -> str:
        """What ``path`` is, relative to ``_base``; parts with / between them."""

    def write(
        self,
        scan: Scan,
        index: int,
        *,
        name: str | None = None,
        image: Image | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        """Write one scan; it is whole when this returns.

        Args:
            scan: what to write.
            index, name: as for ``path``.
            image: (H, W, 3) uint8 RGB taken with the scan; without it ``scan.image_path`` is copied.
            calibration: the camera of this scan, where it is not the writer's.

        Raises:
            FileError: where the folder cannot be written or the disk is full.
            DataError: on a scan that the layout cannot hold.
        """
        picture = scan.image_path if image is None else image
        self._put(scan, self.path(index, name), picture, calibration or self.calibration)

    @abstractmethod
    def _put(self, scan: Scan, path: Path, picture: Picture | None, camera: Calibration | None) -> None:
        """Write the files of a scan, ``path`` last."""

    def complete(self, index: int, name: str | None = None) -> bool:
        """Whether the scan is already there, whole."""
        return self.path(index, name).is_file()

    def carry(self, source: ScanFiles) -> list[str]:
        """Take over what a source knows beside its scans, before they are written.

        Returns:
            What the layout has a place for and the source does not tell, in words; it is left out.

        Raises:
            FileError: where it cannot be read or written.
        """
        return []

    def finish(self) -> None:  # noqa: B027 - a layout of single files has nothing to gather
        """Write what belongs to the whole folder. Calling it again changes nothing."""


class FileWriter(Writer):
    """A writer of one file per scan, ``<name><suffix>`` under the output folder."""

    suffix: str

    def _place(self, index: int, name: str | None) -> str:
        return f"{name or f'{index:06d}'}{self.suffix}"


def write_image(path: Path, picture: Picture) -> None:
    """A PNG from (H, W, 3) uint8 values, or from another image file (a PNG is copied as it is).

    Raises:
        FileError: where it cannot be read or written.
    """
    if isinstance(picture, Path) and picture.suffix.lower() == path.suffix:
        write_file(path, read_file(picture))
        return
    from PIL import Image as pillow

    opened = read_picture(picture) if isinstance(picture, Path) else pillow.fromarray(picture)
    write_file(path, lambda file: opened.convert("RGB").save(file, "PNG"))


def claim(path: Path, settings: dict[str, Any]) -> None:
    """Say in a file what an output folder is being filled with; refuse a folder that holds something else.

    Without it, a rerun with other settings would keep the old scans and pass them off as new ones.

    Args:
        path: the file, in the output folder.
        settings: plain values that decide what is written.

    Raises:
        ConfigError: where the folder was filled with other settings.
        DataError: where the file is damaged.
        FileError: where it cannot be read or written.
    """
    wanted = json.loads(json.dumps(settings))
    if not path.is_file():
        # another one may be as quick
        write_file(path, json.dumps(wanted, indent=1).encode(), overwrite=False)
    there = parse_json(read_text(path), f"{path}, which is damaged,", "what this package wrote into an output folder")
    if not isinstance(there, dict):
        raise DataError(f"{path} is damaged (it holds {type(there).__name__})", hint="Choose another output folder.")
    other = {name: there[name] for name, value in wanted.items() if there.get(name, value) != value}
    if other:
        raise ConfigError(
            f"{path.parent} was filled with {other}",
            f"{ {name: wanted[name] for name in other} }",
            "Type the same options to go on with it, or choose another folder.",
        )


def write_note(folder: Path, frame: int, facts: dict[str, Any]) -> None:
    """Keep what a whole-folder file will need of one frame (plain values; floats stay exact).

    Raises:
        FileError: where it cannot be written.
    """
    write_file(folder / NOTES / f"{frame:010d}.json", json.dumps(facts).encode())


def read_notes(folder: Path) -> dict[int, dict[str, Any]]:
    """{frame: facts} of the notes in a folder, by frame.

    Raises:
        DataError: on a note that was damaged since.
    """
    notes = {}
    for path in list_files(folder / NOTES, ".json") if (folder / NOTES).is_dir() else []:
        try:
            notes[int(path.stem)] = parse_json(read_text(path), str(path))
        except ValueError as error:
            raise DataError(f"{path} is not a note of this package ({error})", hint=f"Remove {path.parent}.") from error
    return notes


def clear_notes(folder: Path) -> None:
    """Remove the notes of a folder, once they stand where they belong."""
    shutil.rmtree(folder / NOTES, ignore_errors=True)
