"""Engine ``slurm``: an array of Slurm jobs by submitit, all writing to a folder that every node sees.

Job k of n takes every n-th shard. submitit puts a job that was preempted or ran out of time back into the queue; it
goes on where whole shards end.
"""

from collections.abc import Sequence
from typing import Any

from lidar_synth.bake.job import Plan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard
from lidar_synth.errors import FileError, LibraryError

LOGS = ".slurm"
"""Folder of the jobs' logs, in the bank's folder."""


class Part:
    """What one job makes. submitit calls it, and asks it what to run again after a preemption."""

    def __call__(self, plan: Plan, numbers: Sequence[int]) -> int:
        """The number of scans of the shards."""
        return sum(bake_shard(plan, number).scans for number in numbers)

    def checkpoint(self, plan: Plan, numbers: Sequence[int]) -> Any:
        """The same: shards that are finished are passed over."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, plan, numbers)


def bake_on_slurm(plan: Plan, numbers: Sequence[int], resources: Resources, progress: Progress) -> None:
    """Make the shards by an array of ``resources.workers`` jobs and wait for them.

    Raises:
        LibraryError: where submitit is not installed.
        FileError: where a job failed.
    """
    try:
        import submitit
    except ImportError as error:
        raise LibraryError(
            f"engine 'slurm', but submitit cannot be imported ({error})",
            "the extra slurm",
            "pip install 'lidar_synth[slurm]'",
        ) from error
    workers = min(resources.workers, len(numbers))
    executor = submitit.AutoExecutor(folder=plan.out / LOGS)
    accelerator = {"gpus_per_node": 1} if plan.job.device == "cuda" else {"cpus_per_task": plan.job.threads}
    executor.update_parameters(name="lidar-synth-bake", **accelerator, **resources.slurm)
    jobs = executor.map_array(Part(), [plan] * workers, [numbers[k::workers] for k in range(workers)])
    for job in submitit.helpers.as_completed(jobs):
        try:
            progress(job.result())
        except submitit.core.utils.UncompletedJobError as error:
            raise FileError(
                f"Slurm job {job.job_id} failed ({error})",
                f"jobs that finish; their logs are in {plan.out / LOGS}",
                "Run the same again: finished shards are kept.",
            ) from error
