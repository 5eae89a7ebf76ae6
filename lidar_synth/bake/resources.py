"""The resources of an engine."""

from dataclasses import dataclass, field

from lidar_synth.errors import check_count


@dataclass(frozen=True)
class Resources:
    """The resources of one run. They change its duration, never its result.

    Args:
        workers: number of concurrent processes, actors or jobs; with device cuda each one uses its
            own GPU.
        address: address of a Ray cluster; by default Ray starts on this machine.
        slurm: options of submitit for the jobs, for instance {"slurm_partition": "gpu",
            "timeout_min": 240}.

    Raises:
        ConfigError: on fewer than one worker.
    """

    workers: int = 1
    address: str | None = None
    slurm: dict[str, str | int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_count("workers", self.workers, 1)
