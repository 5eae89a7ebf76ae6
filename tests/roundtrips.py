"""Shared parts of the format tests: reading back what was written, and comparing it."""

from pathlib import Path

import numpy as np
from layouts import WRITTEN_AS

from lidar_synth.formats import READERS, open_scans
from lidar_synth.formats.source import ScanFiles


def back(to: str, root: Path) -> ScanFiles:
    source = open_scans(root)
    assert type(source) is READERS[WRITTEN_AS[to]]
    return source


def same(a: object, b: object) -> bool:
    return (a is None and b is None) or bool(
        np.array_equal(np.asarray(a), np.asarray(b))
    )
