"""From sensor to sensor: surfaces estimated from a scan, seen again by other beams from another
mount."""

from lidar_synth.geometry.transfer.mount import Mount
from lidar_synth.geometry.transfer.response import Response
from lidar_synth.geometry.transfer.returns import Measurement
from lidar_synth.geometry.transfer.transfer import SeenAs, Transfer, Transferred

__all__ = ["Measurement", "Mount", "Response", "SeenAs", "Transfer", "Transferred"]
