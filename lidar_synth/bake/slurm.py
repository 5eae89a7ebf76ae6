"""Engine ``slurm``: an array of Slurm jobs through submitit, all writing to a folder that every
node shares.

Slurm job k of n takes every n-th shard. submitit requeues a job that was preempted or ran out of
time; it resumes after its last finished shard. The options are submitit's (``slurm_partition``,
``timeout_min``), and ``cluster``: "local" runs the jobs as processes of this machine, to test
without Slurm.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lidar_synth.bake.folder import LOGS
from lidar_synth.bake.job import BakePlan
from lidar_synth.bake.resources import Resources
from lidar_synth.bake.shard import Progress, bake_shard
from lidar_synth.errors import ConfigError, FileError, LidarSynthError

# Submitit's default of 5 minutes may be too short for a shard.
_OPTIONS = {"cluster": "slurm", "timeout_min": 240}
_TIMEOUTS = 1000  # how often a job may run out of time and resume
_POLL = 1  # seconds between two checks of the jobs


class SlurmTask:
    """The work of one job. submitit calls it, and calls ``checkpoint`` to requeue it after a
    preemption."""

    def __call__(self, plan: BakePlan, numbers: Sequence[int]) -> int:
        """Write the shards and return their number of scans."""
        return sum(bake_shard(plan, number).scans for number in numbers)

    def checkpoint(self, plan: BakePlan, numbers: Sequence[int]) -> Any:
        """The same task again: finished shards are skipped."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, plan, numbers)


def bake_on_slurm(
    plan: BakePlan, numbers: Sequence[int], resources: Resources, progress: Progress
) -> None:
    """Write the shards with an array of ``resources.workers`` jobs and wait for them.

    Raises:
        ConfigError: if Slurm is not available, or on an option that submitit does not have or Slurm
            refuses.
        FileError: if a job failed; the others are cancelled.
    """
    import submitit

    jobs = _submit(submitit, plan, numbers, resources)
    try:
        for job in submitit.helpers.as_completed(jobs, poll_frequency=_POLL):
            progress(job.result())
    except submitit.core.utils.UncompletedJobError as error:
        # the last error of the job's trace, if it is one of ours
        named = re.findall(rf"^{LidarSynthError.__module__}\.\w+: .*", str(error), re.M)
        raise FileError(
            f"Slurm job {job.job_id} failed ({(named or [error])[-1]})",
            f"jobs that finish; their logs are in {_logs(plan)}",
            "Run the same command again: finished shards are kept.",
        ) from error
    finally:
        for job in jobs:
            if not job.done():
                job.cancel()


def _submit(
    submitit: Any, plan: BakePlan, numbers: Sequence[int], resources: Resources
) -> Any:
    """The jobs, each with its part of the shards."""
    workers = min(resources.workers, len(numbers))
    share = (
        {"gpus_per_node": 1}
        if plan.job.device == "cuda"
        else {"cpus_per_task": plan.job.threads}
    )
    values = _OPTIONS | share | resources.slurm
    cluster = values.pop("cluster")
    try:
        executor = submitit.AutoExecutor(
            _logs(plan), cluster, **{f"{cluster}_max_num_timeout": _TIMEOUTS}
        )
        executor.update_parameters(name="lidar-synth-bake", **values)
        return executor.map_array(
            SlurmTask(), [plan] * workers, [numbers[k::workers] for k in range(workers)]
        )
    except (RuntimeError, ValueError, NameError, TypeError) as error:
        raise ConfigError(
            f"--slurm {resources.slurm} ({error})",
            "a machine that submits to Slurm, and options of submitit that Slurm accepts",
        ) from error


def _logs(plan: BakePlan) -> Path:
    """The folder of the jobs' logs: in the bank's folder, or, for a URL, in this one."""
    return Path(LOGS) if isinstance(plan.out, str) else plan.out / LOGS
