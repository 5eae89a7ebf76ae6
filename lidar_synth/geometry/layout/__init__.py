"""Layouts: what stands where around the sensor, and its image on the sensor's rays."""

from lidar_synth.geometry.layout.estimate import layout_of, select_known_boxes
from lidar_synth.geometry.layout.layout import CHANNELS, CODES, Layout, Outline
from lidar_synth.geometry.layout.raster import layout_image

__all__ = [
    "CHANNELS",
    "CODES",
    "Layout",
    "Outline",
    "layout_image",
    "layout_of",
    "select_known_boxes",
]
