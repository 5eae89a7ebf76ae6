"""Scan surgery: objects removed from scans, set into them and moved, on the rays of the scan."""

from lidar_synth.labels.edit.insertion import insert, move
from lidar_synth.labels.edit.removal import remove
from lidar_synth.labels.edit.unboxed import Unboxed, closed, measure

__all__ = ["Unboxed", "closed", "insert", "measure", "move", "remove"]
