"""Engine ``local``: the shards one after the other, in this process."""

from collections.abc import Sequence

from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard


def bake_local(
    plan: BakePlan, numbers: Sequence[int], resources: Resources, progress: Progress
) -> None:
    """Write the shards in this process."""
    for number in numbers:
        bake_shard(plan, number, progress)
