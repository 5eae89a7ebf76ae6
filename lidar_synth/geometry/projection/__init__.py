"""Points to range image and back (geometry only: no networks, no files)."""

from lidar_synth.geometry.projection.batch import BatchImage, project_batch
from lidar_synth.geometry.projection.rings import ring_numbers
from lidar_synth.geometry.projection.spherical import (
    Cells,
    carry,
    locate,
    project,
    unproject,
)
from lidar_synth.geometry.projection.unfold import laser_rows, unfold

__all__ = [
    "BatchImage",
    "Cells",
    "carry",
    "laser_rows",
    "locate",
    "project",
    "project_batch",
    "ring_numbers",
    "unfold",
    "unproject",
]
