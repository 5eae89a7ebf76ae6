"""Training runs from a configuration: what they leave, how they go on after a kill, what they refuse."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from accelerate.state import AcceleratorState
from conftest import random_scan
from safetensors import safe_open
from safetensors.torch import load_file
from typer.testing import CliRunner

import lidar_synth.train.plan as plan_module
import lidar_synth.train.run as module
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.flow.path import Example
from lidar_synth.flow.solvers import uniform_grid
from lidar_synth.formats import WRITERS
from lidar_synth.generate.checkpoint import VELOCITY, load_checkpoint, read_header
from lidar_synth.generate.generator import load_generator
from lidar_synth.geometry.sensor import Sensor

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Small tensors, and the same sums in every process."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
    AcceleratorState._reset_state(True)


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of small labelled scans, and the sensor's file."""
    folder = tmp_path_factory.mktemp("scans")
    writer = WRITERS["npz"](folder / "scans")
    for i in range(6):
        writer.write(random_scan(SENSOR, 400, i), i)
    values = SENSOR.to_dict()
    (folder / "sensor.yaml").write_text(yaml.safe_dump({values.pop("name"): values}))
    return folder


def write_config(scans: Path, folder: Path, **changes: Any) -> Path:
    recipe = {"iterations": 12, "batch": 4, "warmup": 2, "rate": 1e-2, "ema_every": 1}
    values = {
        "output": str(folder / "run"),
        "licence": "MIT",
        "data": {"licence": "none", "path": str(scans / "scans"), "flip": True},
        "recipe": recipe | changes.pop("recipe", {}),
        "save_every": 4,
        "samples": {"every": 0},
    }
    if "teacher" not in changes:
        values |= {
            "sensor": str(scans / "sensor.yaml"),
            "channels": ["range", "reflectance", "label"],
            "network": {"arguments": {
                "width": 16, "time_width": 16, "depths": [1, 1], "heads": [2, 2], "patch": [2, 2], "window": [3, 3],
            }},
            "steps": 5,
        }  # fmt: skip
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(values | changes))
    return path


def call(*arguments: str | Path) -> str:
    """The command line in this process; errors come out as they are."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def state(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "run" / "state.safetensors")


def test_a_run_leaves_a_checkpoint_that_samples_and_all_else_it_promises(scans: Path, tmp_path: Path) -> None:
    out = call("train", write_config(scans, tmp_path, samples={"every": 6, "count": 2}))
    run = tmp_path / "run"
    assert str(run / "run.safetensors") in out
    assert sorted(p.name for p in (run / "samples").iterdir()) == ["0000006.png", "0000012.png"]
    assert list((run / "logs").iterdir())
    assert yaml.safe_load((run / "config.yaml").read_text())["recipe"]["metric"] == "squared_l2"
    header, _ = read_header(run / "run.safetensors")
    assert header.time_grid == uniform_grid(5)
    assert header.provenance["iterations"] == 12
    assert header.provenance["data"]["path"] == str(scans / "scans")
    [scan] = load_generator(run / "run.safetensors").scans(0, [0])
    assert (scan.id, scan.sensor) == ("run/0/0", SENSOR)
    saved = state(tmp_path)
    checkpoint = load_checkpoint(run / "run.safetensors").networks[VELOCITY].state_dict()
    assert all(torch.equal(saved[f"average.{name}"], value) for name, value in checkpoint.items())
    assert not all(torch.equal(saved[f"network.{name}"], value) for name, value in checkpoint.items())


def test_a_killed_run_goes_on_as_if_nothing_had_happened(scans: Path, tmp_path: Path) -> None:
    configs = {}
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
        configs[name] = write_config(
            scans, tmp_path / name, recipe={"iterations": 100, "batch": 2}, save_every=5, samples={"every": 0}
        )
    process = subprocess.Popen(
        [sys.executable, "-m", "lidar_synth", "train", configs["killed"]],
        env=os.environ | {"OMP_NUM_THREADS": "1"}, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    path = tmp_path / "killed" / "run" / "state.safetensors"
    while not path.exists():
        assert process.poll() is None, "the run ended before it was saved"
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    with safe_open(path, "pt") as file:
        assert 5 <= int(file.metadata()["step"]) < 100
    with pytest.raises(ConfigError, match="run holds a run; expected --resume"):
        call("train", configs["killed"])
    call("train", configs["killed"], "--resume")
    call("train", configs["whole"])
    resumed, whole = state(tmp_path / "killed"), state(tmp_path / "whole")
    assert resumed.keys() == whole.keys()
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)


def test_two_processes_train_as_one(scans: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    call("train", write_config(scans, tmp_path / "one"))
    config = write_config(scans, tmp_path / "two")
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*torchrun, "-m", "lidar_synth", "train", config],
        env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(tmp_path / "two" / "run" / "run.safetensors")]
    one, two = state(tmp_path / "one"), state(tmp_path / "two")
    for name in one:
        assert torch.allclose(one[name], two[name], atol=1e-4), name
    assert len(list((tmp_path / "two" / "run" / "logs").iterdir())) == 1  # and not a run each


def test_minutes_stop_a_run_and_resume_goes_on(scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = write_config(scans, tmp_path)
    call("train", config, "--minutes", "0")
    path = tmp_path / "run" / "run.safetensors"
    assert read_header(path)[0].provenance["iterations"] == 1
    seen, steps = [], module.steps

    def watched(*arguments: Any) -> Iterator[Any]:
        for record in steps(*arguments):
            seen.append(record.step)
            yield record

    monkeypatch.setattr(module, "steps", watched)
    call("train", config, "--resume")
    assert seen == list(range(2, 13))
    assert read_header(path)[0].provenance["iterations"] == 12


def test_what_is_not_finite_stops_the_run_and_keeps_the_last_good_checkpoint(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = write_config(scans, tmp_path)
    task, calls = plan_module.teacher_task(), []

    def poisoned(batch: Any) -> Example:
        calls.append(batch)
        example = task(batch)
        return Example(example.y, example.t, example.velocity * (torch.nan if len(calls) == 7 else 1))

    monkeypatch.setattr(plan_module, "teacher_task", lambda timesteps: poisoned)
    with pytest.raises(DataError, match=r"step 7: the loss is nan.*last saved state and checkpoint are kept"):
        call("train", config)
    assert read_header(tmp_path / "run" / "run.safetensors")[0].provenance["iterations"] == 4
    assert load_generator(tmp_path / "run" / "run.safetensors").scans(0, [0])
    assert all(value.isfinite().all() for value in state(tmp_path).values())
    call("train", config, "--resume")  # the cause is gone: it goes on from there


@pytest.fixture(scope="module")
def teacher(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("teacher")
    call("train", write_config(scans, folder))
    return folder / "run" / "run.safetensors"


def test_fine_tuning_starts_from_a_checkpoint(scans: Path, teacher: Path, tmp_path: Path) -> None:
    config = write_config(scans, tmp_path, recipe={"iterations": 1, "rate": 1e-9})
    call("train", config, f"init={teacher}")
    start, end = (load_checkpoint(p) for p in (teacher, tmp_path / "run" / "run.safetensors"))
    assert end.header.provenance["init"] == start.hash
    for a, b in zip(start.networks[VELOCITY].parameters(), end.networks[VELOCITY].parameters(), strict=True):
        assert torch.allclose(a, b, atol=1e-6)
    short = yaml.safe_load(config.read_text())
    for key in ("sensor", "channels", "network"):
        del short[key]  # they are the checkpoint's
    config.write_text(yaml.safe_dump(short))
    call("train", config, f"init={teacher}", f"output={tmp_path / 'short'}")
    assert read_header(tmp_path / "short" / "short.safetensors")[0].sensor == SENSOR
    for other in ("sensor=town", "channels=[range]", "network.arguments.width=32"):
        with pytest.raises(ConfigError, match=f"expected that of {teacher}.*Or leave out {other.split('=')[0][:6]}"):
            call("train", config, f"init={teacher}", other, f"output={tmp_path / 'other'}")


@pytest.mark.parametrize(
    ("strategy", "grid"), [("adaptive_piecewise", None), ("uniform_piecewise", uniform_grid(4)), ("reflow", None)]
)
def test_a_student_is_distilled(
    strategy: str,
    grid: tuple[float, ...] | None,
    scans: Path,
    teacher: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    selection = {"candidates": 10, "trajectories": 3}
    config = write_config(
        scans, tmp_path, teacher=str(teacher), strategy=strategy, steps=2, selection=selection,
        recipe={"metric": "pseudo_huber"},
    )  # fmt: skip
    call("distill", config, *([f"grid={list(grid)}"] if grid else []))
    header, _ = read_header(tmp_path / "run" / "run.safetensors")
    assert header.provenance["teacher"] == load_checkpoint(teacher).hash
    assert str(teacher) not in json.dumps(header.provenance)
    if strategy != "adaptive_piecewise":
        assert header.time_grid == uniform_grid(4)
        return
    with np.load(tmp_path / "run" / "selection.npz") as found:
        assert header.time_grid == tuple(found["grid"])
        assert found["cost"] <= found["uniform_cost"]
        assert found["per_trajectory"].shape == (3, 3)
    monkeypatch.delattr(plan_module, "select_timesteps")  # it is not called again
    call("distill", config, "--resume", "recipe.iterations=14")
    assert read_header(tmp_path / "run" / "run.safetensors")[0].time_grid == header.time_grid


def test_a_cache_of_other_scans_is_refused(scans: Path, teacher: Path, tmp_path: Path) -> None:
    config = write_config(scans, tmp_path)
    with pytest.raises(ConfigError, match="cache of other data"):
        call("train", config, f"data.cache={teacher.parent / 'cache'}", "data.on_bad=skip")
