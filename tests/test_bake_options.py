"""What ``lidar-synth bake`` refuses or says before it starts."""

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from small_models import write
from typer.testing import CliRunner

from lidar_synth.bake.estimate import Estimate
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, LibraryError


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("model") / "small.safetensors")


def run(model: Path, out: Path, options: str) -> Any:
    call = ["bake", str(out), "--model", str(model), "--count", "4", *options.split()]
    return CliRunner().invoke(app, call, catch_exceptions=False)


def test_a_dry_run_needs_no_gpu_where_the_bake_needs_none(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "submitit", sys)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    on_slurm = "--device cuda --engine slurm --fields label --dry-run"
    output = run(model, tmp_path, on_slurm).output
    assert "4 scans in 1 shard of up to 64" in output
    assert "fields: range, label; " in output
    assert "seconds with 1 worker on a cpu, " in output
    with pytest.raises(ConfigError, match="device 'cuda'"):
        run(model, tmp_path, "--device cuda --dry-run")


@pytest.mark.parametrize(
    ("options", "said"),
    {
        "": "8.0 minutes with 1 worker, 0.01 scans/s",
        "--workers 2": "4.0 minutes with 2 workers, 0.02 scans/s",
        "--workers 3": "4.0 minutes with 3 workers, 0.02 scans/s",
        "--workers 16": "2.0 minutes with 4 workers, 0.03 scans/s",
        "--workers 16 --count 10": "96 seconds with 8 workers, 0.10 scans/s",
        "--workers 2 --num-shards 2 --shard-index 1": "2.0 minutes with 2 workers",
        "--num-shards 8 --shard-index 5": "0 seconds with 1 worker, 0.00 scans/s",
    }.items(),
)
def test_a_dry_run_divides_the_time_by_the_workers(
    options: str,
    said: str,
    model: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    measured = Estimate(1e6, 480.0, "cpu")
    monkeypatch.setattr("lidar_synth.bake.estimate.estimate", lambda plan: measured)
    monkeypatch.setattr("lidar_synth.files.processes.usable_cores", lambda: 8)
    assert said in run(model, tmp_path, f"--shard-size 1 {options} --dry-run").output


def test_unboxed_objects_are_counted_once(tmp_path: Path) -> None:
    """Not again by a call that finds the bank finished."""
    town = Path("town")
    outputs = [run(town, tmp_path / "bank", "--count 1").output for _ in range(2)]
    said = ["objects without a box a scan" in output for output in outputs]
    assert said == [True, False]
    assert all("1 scans in 1 shard, " in output for output in outputs)


def test_a_dry_run_needs_what_the_engine_needs(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(LibraryError, match="engine 'ray', but ray cannot be imported"):
        run(model, tmp_path, "--engine ray --dry-run")
    with pytest.raises(ConfigError, match="engine 'torchrun' without 'RANK'"):
        run(model, tmp_path, "--engine torchrun --dry-run")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            "--engine local --workers 8",
            "--workers with engine 'local'; expected engine 'processes' or 'ray'",
        ),
        ("--engine processes --address auto", "--address with engine 'processes'"),
        ("--engine local --slurm cluster=local", "--slurm with engine 'local'"),
        ("--num-shards 16", "--num-shards 16 without --shard-index; expected"),
    ],
)
def test_options_that_would_be_ignored_are_refused(
    options: str, message: str, model: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        run(model, tmp_path / "bank", options)
    assert not (tmp_path / "bank").exists()


def test_workers_without_a_shard_are_reported(model: Path, tmp_path: Path) -> None:
    options = "--count 9 --shard-size 9 --workers 4 --dry-run"
    assert run(model, tmp_path, options).output.startswith(
        "1 shard for 4 workers: --shard-size 2 of a new bank uses all\n"
    )
    assert (
        "for 4 workers" not in run(model, tmp_path, f"{options} --shard-size 2").output
    )
    assert "uses all" not in run(model, tmp_path, f"{options} --count 3").output
    assert "uses all" not in run(model, tmp_path, "--dry-run").output
