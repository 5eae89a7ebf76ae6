"""The skin of a sensor: its returns as learnt from real scans, put on the scans of the town."""

from lidar_synth.lab.town.skin.skin import Skin, load_skin

__all__ = ["Skin", "load_skin"]
