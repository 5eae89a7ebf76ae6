"""Baking: writing banks of generated scans, on one machine or many.

``options`` holds the settings and ``job`` the plan; ``shard`` writes one shard, whichever engine
calls it; ``run`` writes a complete bank, in this process or with one of the other engines
(``processes``, ``ray_actors``, ``slurm``, ``torchrun``). ``verify``, ``repair`` and ``edit``
maintain existing banks.

Each name is imported when it is first used, so that the command line can read ``BakeJob`` without
importing torch.
"""

from functools import partial
from typing import TYPE_CHECKING

from lidar_synth.errors import import_name

_HOME = {
    "ENGINES": "run",
    "BakeJob": "options",
    "BakePlan": "job",
    "Resources": "resources",
    "Share": "share",
    "bake": "run",
    "bake_shard": "shard",
    "make_plan": "job",
}

__all__ = [*_HOME]

if TYPE_CHECKING:
    from lidar_synth.bake.job import (
        BakePlan as BakePlan,
        make_plan as make_plan,
    )
    from lidar_synth.bake.options import BakeJob as BakeJob
    from lidar_synth.bake.resources import Resources as Resources
    from lidar_synth.bake.run import (
        ENGINES as ENGINES,
        bake as bake,
    )
    from lidar_synth.bake.shard import bake_shard as bake_shard
    from lidar_synth.bake.share import Share as Share

__getattr__ = partial(import_name, __name__, _HOME)
