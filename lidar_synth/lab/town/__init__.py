"""The procedural town: synthetic streets, ray-cast with a sensor's beams (no download, no neural
network)."""

from lidar_synth.lab.town.export import LAYOUTS, export_town
from lidar_synth.lab.town.pasted import TownObjects, collect_objects
from lidar_synth.lab.town.shapes import collect_shapes
from lidar_synth.lab.town.skin import Skin, load_skin
from lidar_synth.lab.town.skin.fit import fit_skin
from lidar_synth.lab.town.town import Town
from lidar_synth.lab.town.world import STRETCH_FRAMES

__all__ = [
    "LAYOUTS",
    "STRETCH_FRAMES",
    "Skin",
    "Town",
    "TownObjects",
    "collect_objects",
    "collect_shapes",
    "export_town",
    "fit_skin",
    "load_skin",
]
