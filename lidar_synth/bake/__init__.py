"""Baking: banks made by a generator, on one machine or many.

``job`` holds the settings and the plan, ``shard`` makes one shard whoever asks, ``run`` makes a whole bank by one of
the engines (``local``, ``processes``, ``ray_actors``, ``slurm``, ``torchrun``); ``verify``, ``repair`` and ``edit``
look after banks that are there.
"""

from lidar_synth.bake.job import BakeJob, BakePlan, make_plan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.run import ENGINES, Share, bake
from lidar_synth.bake.shard import bake_shard

__all__ = ["ENGINES", "BakeJob", "BakePlan", "Resources", "Share", "bake", "bake_shard", "make_plan"]
