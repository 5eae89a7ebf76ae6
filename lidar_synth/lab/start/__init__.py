"""From a folder of scans to a mixture for a training, in one call: ``start``."""

from lidar_synth.lab.start.run import Started, start

__all__ = ["Started", "start"]
