"""The procedural town: synthetic streets, ray-cast with a sensor's beams (no download, no neural network)."""

from lidar_synth.town.export import LAYOUTS, export_town
from lidar_synth.town.town import Town
from lidar_synth.town.world import STRETCH_FRAMES

__all__ = ["LAYOUTS", "STRETCH_FRAMES", "Town", "export_town"]
