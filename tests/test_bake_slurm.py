"""Engine ``slurm`` with submitit's executor for one machine: real jobs, their logs, and
failures."""

import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from bakes import COUNT, files, plan_in
from test_generator import write

from lidar_synth.bake import ENGINES, BakePlan, Resources, bake
from lidar_synth.bake.folder import prepare
from lidar_synth.bake.slurm import LOGS, SlurmTask
from lidar_synth.bank.index import SETTINGS
from lidar_synth.errors import ConfigError, FileError
from lidar_synth.files.disk import write_file

submitit = pytest.importorskip(
    "submitit", reason="submitit is not installed: pip install 'lidar_synth[slurm]'"
)
cloudpickle = pytest.importorskip("cloudpickle")  # comes with it

LOCAL = {"cluster": "local"}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "small.safetensors")


@pytest.fixture
def plan(model: Path, tmp_path: Path) -> BakePlan:
    return plan_in(tmp_path / "bank", model)


def test_jobs_write_the_same_bytes(plan: BakePlan, model: Path, tmp_path: Path) -> None:
    reference = plan_in(tmp_path / "reference" / "bank", model)
    bake(reference, progress=False)
    assert bake(plan, "slurm", Resources(3, slurm=LOCAL), progress=False) is not None
    assert files(plan.out) == files(reference.out)
    assert not (plan.out / LOGS).exists()  # a finished bank needs no logs


class Slow(SlurmTask):
    """A task that waits after its first shard for the signal of a timeout; it does so only once."""

    def __call__(self, plan: BakePlan, numbers: Sequence[int]) -> int:
        if (plan.out / "waited").exists():
            return super().__call__(plan, numbers)
        super().__call__(plan, numbers[:1])
        write_file(plan.out / "waited", str(os.getpid()).encode())
        time.sleep(600)
        raise AssertionError("no signal came")


def test_a_job_that_runs_out_of_time_resumes(plan: BakePlan) -> None:
    """Slurm sends a signal before it takes a node away; submitit then requeues the job."""
    prepare(plan)
    executor = submitit.AutoExecutor(plan.out / LOGS, "local")
    executor.update_parameters(timeout_min=10)
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    job = executor.submit(Slow(), plan, range(4))
    while not (plan.out / "waited").exists():
        assert not job.done(), job.stderr()
        time.sleep(0.1)
    first = (plan.out / "shard-00000.h5").stat()
    os.kill(int((plan.out / "waited").read_text()), signal.SIGUSR2)
    assert job.result() == COUNT, job.stderr()
    assert (
        plan.out / "shard-00000.h5"
    ).stat().st_mtime_ns == first.st_mtime_ns  # not written twice


def test_a_failed_job_is_reported(plan: BakePlan) -> None:
    prepare(plan)
    (plan.out / SETTINGS).unlink()
    with pytest.raises(
        FileError,
        match=r"Slurm job \d+.* failed .*has vanished or lost its .bake.json",
    ) as failed:
        ENGINES["slurm"](plan, range(4), Resources(2, slurm=LOCAL), lambda scans: None)
    assert "Traceback" not in str(failed.value)
    assert len(list((plan.out / LOGS).glob("*.out"))) == 2  # kept for diagnosis
    bake(plan, progress=False)
    assert not (plan.out / LOGS).exists()


def test_what_slurm_says_about_a_wrong_option_is_reported(
    plan: BakePlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("srun", "sbatch"):
        (tmp_path / name).write_text("#!/bin/sh\necho invalid partition >&2; exit 1\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    given = {"slurm_partition": "none"}
    with pytest.raises(
        ConfigError, match=r"--slurm .*'none'.* \(invalid partition\); expected"
    ):
        bake(plan, "slurm", Resources(2, slurm=given), progress=False)


def test_a_missing_slurm_and_unknown_options_are_refused(
    plan: BakePlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", os.devnull)
    with pytest.raises(
        ConfigError,
        match=r'Could not detect "srun".*expected a machine that submits to Slurm',
    ):
        bake(plan, "slurm", progress=False)
    with pytest.raises(ConfigError, match=r"(?s)'speed'.*options of submitit"):
        bake(plan, "slurm", Resources(1, slurm=LOCAL | {"speed": 9}), progress=False)
