"""Real and synthetic scans in one torch dataset, at an exact ratio.

The plan of an epoch (plan.py) is a pure function of seed and epoch; datasets, batch sampler and
stream follow it.
"""

from lidar_synth.mixing.batches import MixedBatches
from lidar_synth.mixing.collate import Collate
from lidar_synth.mixing.domains import ByDomain, settle
from lidar_synth.mixing.items import Item, to_item
from lidar_synth.mixing.plan import MixingPlan
from lidar_synth.mixing.quotas import Mixture, PlannedSource
from lidar_synth.mixing.scans import MixedScans
from lidar_synth.mixing.schedules import (
    Linear,
    SyntheticFirst,
    make_schedule,
)
from lidar_synth.mixing.sources import Sources
from lidar_synth.mixing.stream import MixedStream
from lidar_synth.mixing.synthetic import Held, Synthetic, make_synthetic

__all__ = [
    "ByDomain",
    "Collate",
    "Held",
    "Item",
    "Linear",
    "MixedBatches",
    "MixedScans",
    "MixedStream",
    "MixingPlan",
    "Mixture",
    "PlannedSource",
    "Sources",
    "Synthetic",
    "SyntheticFirst",
    "make_schedule",
    "make_synthetic",
    "settle",
    "to_item",
]
