"""What an engine may use."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Resources:
    """Of one run; they decide how long it takes and nothing else.

    Args:
        workers: processes, actors or jobs at a time; each has a GPU of its own where the device is cuda.
        address: of a Ray cluster; by default one is started on this machine.
        slurm: options of submitit for the jobs, such as {"slurm_partition": "gpu", "timeout_min": 240}.
    """

    workers: int = 1
    address: str | None = None
    slurm: dict[str, str | int] = field(default_factory=dict)
