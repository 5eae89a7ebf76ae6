"""Scan surgery: objects removed from scans, set into them and moved, on the rays of the scan."""

from lidar_synth.labels.edit.insert import insert, move
from lidar_synth.labels.edit.remove import remove
from lidar_synth.labels.edit.unboxed import Unboxed, closed, measure

__all__ = ["Unboxed", "closed", "insert", "measure", "move", "remove"]
