"""Engine ``torchrun``: one of the processes that ``torchrun`` starts; each takes every n-th shard
of the run's share.

The processes do not communicate: the one that finishes last writes the index.
"""

import os

import torch

from lidar_synth.bake.job import BakePlan
from lidar_synth.errors import ConfigError


def take_part(plan: BakePlan, numbers: range) -> range:
    """This process's part of the shards of a run, finished or not: the list of missing shards may
    differ between processes. Its GPU becomes the current one.

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
    return numbers[rank::ranks]
