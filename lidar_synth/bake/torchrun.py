"""Engine ``torchrun``: one of the processes that ``torchrun`` starts; each takes every n-th shard.

The processes do not communicate: the one that finishes last writes the index.
"""

import os
from collections.abc import Sequence

import torch

from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard
from lidar_synth.errors import ConfigError


def bake_under_torchrun(
    plan: BakePlan, numbers: Sequence[int], resources: Resources, progress: Progress
) -> None:
    """Write this process's shards.

    Raises:
        ConfigError: if torchrun did not start this process.
    """
    try:
        rank, ranks, local = (
            int(os.environ[name]) for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK")
        )
    except KeyError as error:
        raise ConfigError(
            f"engine 'torchrun' without {error} in the environment",
            "a process of torchrun",
            "torchrun --nproc-per-node 8 -m lidar_synth bake OUT --engine torchrun ...",
        ) from error
    if plan.job.device == "cuda":
        torch.cuda.set_device(local)
    # By the shard's number in the plan: the list of missing shards may differ between processes.
    for number in numbers:
        if number % ranks == rank:
            bake_shard(plan, number, progress)
