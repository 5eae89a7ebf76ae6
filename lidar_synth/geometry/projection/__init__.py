"""Points to range image and back (geometry only: no networks, no files); ``batch`` does it with
torch, on any device."""

from lidar_synth.geometry.projection.spherical import (
    Cells,
    carry,
    locate,
    project,
    unproject,
)
from lidar_synth.geometry.projection.unfold import laser_rows, unfold

__all__ = [
    "Cells",
    "carry",
    "laser_rows",
    "locate",
    "project",
    "unfold",
    "unproject",
]
