"""Baking: writing banks of generated scans, on one machine or many.

``options`` holds the settings and ``job`` the plan; ``shard`` writes one shard, whichever engine
calls it; ``run`` writes a complete bank, in this process or with one of the other engines
(``processes``, ``ray_actors``, ``slurm``, ``torchrun``). ``verify``, ``repair`` and ``edit``
maintain existing banks.

Each name is imported when it is first used, so that the command line can read ``BakeJob`` without
importing torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

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


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'lidar_synth.bake' has no attribute {name!r}")
    return getattr(import_module(f"lidar_synth.bake.{_HOME[name]}"), name)
