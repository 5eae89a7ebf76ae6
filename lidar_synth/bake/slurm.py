"""Engine ``slurm``: an array of Slurm jobs by submitit, all writing to a folder that every node sees.

BakeJob k of n takes every n-th shard. submitit puts a job that was preempted or ran out of time back into the queue; it
goes on where whole shards end. Options are submitit's (``slurm_partition``, ``timeout_min``), and ``cluster``: "local"
runs the jobs as processes of this machine, to try things without Slurm.
"""

from collections.abc import Sequence
from typing import Any

from lidar_synth.bake.folder import LOGS
from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard
from lidar_synth.errors import ConfigError, FileError, LibraryError

_OPTIONS = {"cluster": "slurm", "timeout_min": 240}  # submitit's own limit is 5 minutes, less than a shard may take
_TIMEOUTS = 1000  # how often a job may run out of time and go on
_LOOK = 1  # seconds between two looks at the jobs


class SlurmTask:
    """What one job makes. submitit calls it, and asks it what to run again after a preemption."""

    def __call__(self, plan: BakePlan, numbers: Sequence[int]) -> int:
        """The number of scans of the shards."""
        return sum(bake_shard(plan, number).scans for number in numbers)

    def checkpoint(self, plan: BakePlan, numbers: Sequence[int]) -> Any:
        """The same: shards that are finished are passed over."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, plan, numbers)


def bake_on_slurm(plan: BakePlan, numbers: Sequence[int], resources: Resources, progress: Progress) -> None:
    """Make the shards by an array of ``resources.workers`` jobs and wait for them.

    Raises:
        LibraryError: where submitit is not installed.
        ConfigError: where there is no Slurm, or an option is none of submitit's.
        FileError: where a job failed; the others are cancelled.
    """
    submitit = _import_submitit()
    workers = min(resources.workers, len(numbers))
    executor = _executor(submitit, plan, resources.slurm)
    jobs = executor.map_array(SlurmTask(), [plan] * workers, [numbers[k::workers] for k in range(workers)])
    try:
        for job in submitit.helpers.as_completed(jobs, poll_frequency=_LOOK):
            progress(job.result())
    except submitit.core.utils.UncompletedJobError as error:
        raise FileError(
            f"Slurm job {job.job_id} failed ({error})",
            f"jobs that finish; their logs are in {plan.out / LOGS}",
            "Run the same again: finished shards are kept.",
        ) from error
    finally:
        for job in jobs:
            if not job.done():
                job.cancel()


def _executor(submitit: Any, plan: BakePlan, options: dict[str, str | int]) -> Any:
    """What takes the jobs, with the options of a job set."""
    share = {"gpus_per_node": 1} if plan.job.device == "cuda" else {"cpus_per_task": plan.job.threads}
    values = _OPTIONS | share | options
    cluster = values.pop("cluster")
    try:
        executor = submitit.AutoExecutor(plan.out / LOGS, cluster, **{f"{cluster}_max_num_timeout": _TIMEOUTS})
        executor.update_parameters(name="lidar-synth-bake", **values)
    except (RuntimeError, ValueError, NameError, TypeError) as error:
        raise ConfigError(
            f"--slurm {options} ({error})", "a machine that submits to Slurm, and options of submitit"
        ) from error
    return executor


def _import_submitit() -> Any:
    try:
        import submitit
    except ImportError as error:
        raise LibraryError(
            f"engine 'slurm', but submitit cannot be imported ({error})",
            "the extra slurm",
            "pip install 'lidar_synth[slurm]'",
        ) from error
    return submitit
