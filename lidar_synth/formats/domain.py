"""Marks folders of synthetic scans by a file beside the scans, because most layouts cannot store the domain."""

import re
from pathlib import Path

from lidar_synth.files.disk import write_file
from lidar_synth.geometry.scan import REAL, SYNTHETIC

MARK = "synthetic.json"
"""File in the root of a folder that marks all of its scans as synthetic."""

TOWN = "town.json"
"""File in the root of a town, with its settings."""

LEVELS = 6
"""Number of folders above a scan that are searched for a mark."""

_OF_A_LAYOUT = re.compile(
    r"velodyne(_points|_reduced)?|data|data_3d_raw|2013_05_28_drive_\d{4}_sync|sequences|\d\d|training|testing"
)


def domain_of(root: Path) -> int:
    """``SYNTHETIC`` if there is a mark beside the scans, or above the folders of their layout; else ``REAL``.

    Args:
        root: a dataset's root, one of its folders, or one scan.
    """
    root = root.resolve()
    folder = root.parent if root.is_file() else root
    for _ in range(LEVELS):
        if any((folder / name).is_file() for name in (MARK, TOWN)):
            return SYNTHETIC
        if not _OF_A_LAYOUT.fullmatch(folder.name):
            break
        folder = folder.parent
    return REAL


def mark_synthetic(root: Path) -> None:
    """Mark all scans of a folder as synthetic.

    Raises:
        FileError: if it cannot be written.
    """
    if domain_of(root) == REAL:
        text = '{"domain": "synthetic", "meaning": "made by a model or in a procedural town; none was measured"}\n'
        write_file(root / MARK, text.encode())
