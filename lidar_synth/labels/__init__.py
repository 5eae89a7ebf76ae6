"""Label policies of synthetic scans by name, and objects that are pasted into scans.

Each name is imported when it is first used: editing loads networks, which a mixture does not need.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

_HOME = {
    "IgnoreLabels": "own",
    "KeepBoxes": "own",
    "KeepCondition": "own",
    "KeepLabels": "own",
    "LaserMix": "mix",
    "POLICIES": "policies",
    "LabelPolicy": "policies",
    "Object": "objects",
    "ObjectBank": "bank",
    "PasteObjects": "mix",
    "PolarMix": "mix",
    "PolarMixOrLaserMix": "mix",
    "PredictLabels": "pseudo",
    "RemoveLabels": "own",
    "instances_of": "objects",
    "make_policy": "policies",
    "objects_of": "objects",
    "paste": "pasting",
    "swap_bands": "exchange",
    "swap_sector": "exchange",
    "thin_scan": "exchange",
}

__all__ = list(_HOME)

if TYPE_CHECKING:
    from lidar_synth.labels.bank import ObjectBank as ObjectBank
    from lidar_synth.labels.exchange import swap_bands as swap_bands
    from lidar_synth.labels.exchange import swap_sector as swap_sector
    from lidar_synth.labels.exchange import thin_scan as thin_scan
    from lidar_synth.labels.mix import LaserMix as LaserMix
    from lidar_synth.labels.mix import PasteObjects as PasteObjects
    from lidar_synth.labels.mix import PolarMix as PolarMix
    from lidar_synth.labels.mix import PolarMixOrLaserMix as PolarMixOrLaserMix
    from lidar_synth.labels.objects import Object as Object
    from lidar_synth.labels.objects import instances_of as instances_of
    from lidar_synth.labels.objects import objects_of as objects_of
    from lidar_synth.labels.own import IgnoreLabels as IgnoreLabels
    from lidar_synth.labels.own import KeepBoxes as KeepBoxes
    from lidar_synth.labels.own import KeepCondition as KeepCondition
    from lidar_synth.labels.own import KeepLabels as KeepLabels
    from lidar_synth.labels.own import RemoveLabels as RemoveLabels
    from lidar_synth.labels.pasting import paste as paste
    from lidar_synth.labels.policies import POLICIES as POLICIES
    from lidar_synth.labels.policies import LabelPolicy as LabelPolicy
    from lidar_synth.labels.policies import make_policy as make_policy
    from lidar_synth.labels.pseudo import PredictLabels as PredictLabels


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'lidar_synth.labels' has no attribute {name!r}")
    return getattr(import_module(f"lidar_synth.labels.{_HOME[name]}"), name)
