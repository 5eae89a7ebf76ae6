"""Scan surgery: objects removed from scans, set into them and moved, on the rays of the scan."""

from lidar_synth.labels.edit.insertion import insert, move
from lidar_synth.labels.edit.removal import remove
from lidar_synth.labels.edit.unboxed import Unboxed, measure, remove_unboxed

__all__ = ["Unboxed", "insert", "measure", "move", "remove", "remove_unboxed"]
