"""Label policies of synthetic scans by name, and objects that are pasted into scans."""

from lidar_synth.labels import edit
from lidar_synth.labels.bank import ObjectBank
from lidar_synth.labels.exchange import swap_bands, swap_sector, thinned
from lidar_synth.labels.objects import Object, instances_of, objects_of
from lidar_synth.labels.pasting import paste
from lidar_synth.labels.policies import KINDS, POLICIES, LabelPolicy, make_policy

__all__ = [
    "KINDS",
    "POLICIES",
    "LabelPolicy",
    "Object",
    "ObjectBank",
    "edit",
    "instances_of",
    "make_policy",
    "objects_of",
    "paste",
    "swap_bands",
    "swap_sector",
    "thinned",
]
