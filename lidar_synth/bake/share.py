"""Independent runs that share the work of a bake."""

import os
from dataclasses import dataclass

from lidar_synth.errors import ConfigError

# The index and the size of an array job; a Kubernetes Indexed Job does not tell its size.
_ARRAYS = {
    "JOB_COMPLETION_INDEX": "",
    "AWS_BATCH_JOB_ARRAY_INDEX": "AWS_BATCH_JOB_ARRAY_SIZE",
    "SLURM_ARRAY_TASK_ID": "SLURM_ARRAY_TASK_COUNT",
    "CLOUD_RUN_TASK_INDEX": "CLOUD_RUN_TASK_COUNT",
    "SKYPILOT_NODE_RANK": "SKYPILOT_NUM_NODES",
}


@dataclass(frozen=True)
class Share:
    """Every n-th shard, for independent runs that share the work.

    Args:
        index: position of the first shard, 0 <= index < of.
        of: number of shares.

    Raises:
        ConfigError: on an index outside this interval.
    """

    index: int = 0
    of: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.of:
            raise ConfigError(
                f"--shard-index {self.index} of --num-shards {self.of}",
                "0 <= index < number",
            )


def read_share(index: str | None, number: int | None) -> Share:
    """The share of a run as the command line names it.

    Args:
        index: of the share; ``"auto"`` takes that of the array job that this process belongs to;
            None for all shards.
        number: of shares; by default 1, or the size of the array job.

    Raises:
        ConfigError: outside an array job, in one with gaps, on anything but numbers, or on several
            shares without an index.
    """
    if index is None and number is not None:
        raise ConfigError(
            f"--num-shards {number} without --shard-index",
            "the index of this run's share",
            "--shard-index auto in an array job.",
        )
    index = "0" if index is None else index
    size = "1" if number is None else str(number)
    if index == "auto":
        found = next((name for name in _ARRAYS if name in os.environ), None)
        if found is None:
            raise ConfigError(
                "--shard-index auto outside an array job",
                f"one of {', '.join(_ARRAYS)}",
            )
        index = os.environ[found]
        if number is None:
            size = os.environ.get(_ARRAYS[found], "")
            last = int(os.environ.get("SLURM_ARRAY_TASK_MAX", "-1"))
            if size.isdigit() and last >= int(size):
                raise ConfigError(
                    f"a Slurm array of {size} tasks up to {last}",
                    "tasks from 0 without gaps, such as --array=0-15",
                    "For a part of them, give --num-shards as well.",
                )
    if not (index.isdigit() and size.lstrip("-").isdigit()):
        raise ConfigError(
            f"--shard-index {index!r} of --num-shards {size!r}",
            "two whole numbers",
            "--shard-index auto --num-shards 16",
        )
    return Share(int(index), int(size))
