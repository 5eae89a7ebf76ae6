"""Training runs from a configuration: what they leave, how they go on after a kill, what they
refuse."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
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

import lidar_synth.lab.train.runs as module
import lidar_synth.lab.train.selection as selection_module
import lidar_synth.lab.train.teacher as teacher_module
from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import WRITERS
from lidar_synth.generate.checkpoint import (
    VELOCITY,
    load_checkpoint,
    read_header,
    save_checkpoint,
)
from lidar_synth.generate.flow.path import Example
from lidar_synth.generate.flow.solvers import uniform_grid
from lidar_synth.generate.flow.timesteps import TrajectoryCosts
from lidar_synth.generate.loading import load_generator
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
            "network": {
                "arguments": {
                    "width": 16,
                    "time_width": 16,
                    "depths": [1, 1],
                    "heads": [2, 2],
                    "patch": [2, 2],
                    "window": [3, 3],
                }
            },
            "steps": 5,
        }
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(values | changes))
    return path


def call(*arguments: str | Path) -> str:
    """The command line in this process; errors come out as they are."""
    AcceleratorState._reset_state(True)  # each call is a run of its own
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def state(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "run" / "state.safetensors")


@pytest.mark.slow
def test_a_run_leaves_a_checkpoint_that_samples_and_all_else_it_promises(
    scans: Path, tmp_path: Path
) -> None:
    out = call("train", write_config(scans, tmp_path, samples={"every": 6, "count": 2}))
    run = tmp_path / "run"
    assert str(run / "run.safetensors") in out
    assert sorted(p.name for p in (run / "samples").iterdir()) == [
        "0000006.png",
        "0000012.png",
    ]
    assert list((run / "logs").iterdir())
    assert (
        yaml.safe_load((run / "config.yaml").read_text())["recipe"]["metric"]
        == "squared_l2"
    )
    header, _ = read_header(run / "run.safetensors")
    assert header.time_grid == uniform_grid(5)
    assert header.provenance["iterations"] == 12
    assert header.provenance["data"]["path"] == str(scans / "scans")
    [scan] = load_generator(run / "run.safetensors").scans(0, [0])
    assert (scan.id, scan.sensor) == ("run/0/0", SENSOR)
    saved = state(tmp_path)
    checkpoint = (
        load_checkpoint(run / "run.safetensors").networks[VELOCITY].state_dict()
    )
    assert all(
        torch.equal(saved[f"average.{name}"], value)
        for name, value in checkpoint.items()
    )
    assert not all(
        torch.equal(saved[f"network.{name}"], value)
        for name, value in checkpoint.items()
    )


@pytest.mark.slow
def test_states_that_a_thread_writes_are_those_of_their_steps(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("at once", "behind"):
        (tmp_path / name).mkdir()
        call("train", write_config(scans, tmp_path / name, recipe={"iterations": 10}))
        monkeypatch.setattr(module, "_writes_behind", lambda device: True)
    one = state(tmp_path / "at once")
    two = state(tmp_path / "behind")
    assert all(torch.equal(one[name], two[name]) for name in one)


BEGUN = re.compile(r" [1-9]\d?/100 ")
"""In a bar that shows a step."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent", "status", "save_every"),
    [("SIGKILL", -9, 5), ("SIGTERM", 130, 1000), ("SIGINT", 130, 1000)],
)
def test_a_killed_run_goes_on_as_if_nothing_had_happened(
    scans: Path, tmp_path: Path, sent: str, status: int, save_every: int
) -> None:
    """A run that is asked to end saves its state first."""
    configs = {}
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
        configs[name] = write_config(
            scans,
            tmp_path / name,
            recipe={"iterations": 100, "batch": 2},
            save_every=save_every,
            samples={"every": 0},
        )
    errors = tmp_path / "errors"
    with errors.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "lidar_synth", "train", configs["killed"]],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stderr=file,
        )
    path = tmp_path / "killed" / "run" / "state.safetensors"
    while not (
        path.exists() or (save_every > 100 and BEGUN.search(errors.read_text()))
    ):
        assert process.poll() is None, errors.read_text()
        time.sleep(0.01)
    os.kill(process.pid, getattr(signal, sent))
    assert process.wait() == status
    with safe_open(path, "pt") as file:
        assert 1 <= int(file.metadata()["step"]) < 100
    assert "Traceback" not in errors.read_text()
    with pytest.raises(ConfigError, match="run holds a run; expected --resume"):
        call("train", configs["killed"])
    call("train", configs["killed"], "--resume")
    call("train", configs["whole"])
    resumed = state(tmp_path / "killed")
    whole = state(tmp_path / "whole")
    assert resumed.keys() == whole.keys()
    assert all(torch.equal(resumed[name], whole[name]) for name in whole)


@pytest.mark.slow
def test_two_processes_train_as_one(scans: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    call("train", write_config(scans, tmp_path / "one"))
    config = write_config(scans, tmp_path / "two")
    torchrun = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        "2",
    ]
    done = subprocess.run(
        [*torchrun, "-m", "lidar_synth", "train", config],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(tmp_path / "two" / "run" / "run.safetensors")]
    one = state(tmp_path / "one")
    two = state(tmp_path / "two")
    for name in one:
        assert torch.allclose(one[name], two[name], atol=1e-4), name
    # and not a run each
    assert len(list((tmp_path / "two" / "run" / "logs").iterdir())) == 1


@pytest.mark.parametrize("minutes", ["-1", "nan", "inf"])
def test_minutes_that_are_no_time_are_refused(minutes: str, tmp_path: Path) -> None:
    given = ["town_tiny", f"output={tmp_path / 'run'}", "--minutes", minutes]
    with pytest.raises(ConfigError, match="minutes; expected a finite number of at l"):
        call("train", *given)
    assert not (tmp_path / "run").exists()


def test_minutes_stop_a_run_and_resume_goes_on(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = write_config(scans, tmp_path)
    call("train", config, "--minutes", "0")
    path = tmp_path / "run" / "run.safetensors"
    assert read_header(path)[0].provenance["iterations"] == 1
    seen = []
    steps = module.steps

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
    task = teacher_module.teacher_task()
    calls = []

    def poisoned(batch: Any) -> Example:
        calls.append(batch)
        example = task(batch)
        return Example(
            example.y,
            example.t,
            example.velocity * (torch.nan if len(calls) == 7 else 1),
        )

    monkeypatch.setattr(teacher_module, "teacher_task", lambda timesteps: poisoned)
    with pytest.raises(
        DataError,
        match=r"step 7: the loss is nan.*last saved state and checkpoint are kept",
    ):
        call("train", config)
    assert (
        read_header(tmp_path / "run" / "run.safetensors")[0].provenance["iterations"]
        == 4
    )
    assert load_generator(tmp_path / "run" / "run.safetensors").scans(0, [0])
    assert all(value.isfinite().all() for value in state(tmp_path).values())
    call("train", config, "--resume")  # the cause is gone: it goes on from there


@pytest.fixture(scope="module")
def teacher(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("teacher")
    call("train", write_config(scans, folder))
    return folder / "run" / "run.safetensors"


@pytest.mark.slow
def test_fine_tuning_starts_from_a_checkpoint(
    scans: Path, teacher: Path, tmp_path: Path
) -> None:
    config = write_config(scans, tmp_path, recipe={"iterations": 1, "rate": 1e-9})
    call("train", config, f"init={teacher}")
    start, end = (
        load_checkpoint(p) for p in (teacher, tmp_path / "run" / "run.safetensors")
    )
    assert end.header.provenance["init"] == start.hash
    for a, b in zip(
        start.networks[VELOCITY].parameters(),
        end.networks[VELOCITY].parameters(),
        strict=True,
    ):
        assert torch.allclose(a, b, atol=1e-6)
    short = yaml.safe_load(config.read_text())
    for key in ("sensor", "channels", "network"):
        del short[key]  # they are the checkpoint's
    config.write_text(yaml.safe_dump(short))
    call("train", config, f"init={teacher}", f"output={tmp_path / 'short'}")
    assert read_header(tmp_path / "short" / "short.safetensors")[0].sensor == SENSOR
    for other in ("sensor=town", "channels=[range]", "network.arguments.width=32"):
        with pytest.raises(
            ConfigError,
            match=f"expected that of {teacher}.*Or leave out {other.split('=')[0][:6]}",
        ):
            call(
                "train",
                config,
                f"init={teacher}",
                other,
                f"output={tmp_path / 'other'}",
            )


@pytest.mark.parametrize(
    ("strategy", "grid"),
    [
        ("adaptive_piecewise", None),
        ("uniform_piecewise", uniform_grid(4)),
        ("reflow", None),
    ],
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
        scans,
        tmp_path,
        teacher=str(teacher),
        strategy=strategy,
        steps=2,
        selection=selection,
        recipe={"metric": "pseudo_huber"},
    )
    call("distill", config, *([f"grid={list(grid)}"] if grid else []))
    header, _ = read_header(tmp_path / "run" / "run.safetensors")
    assert header.provenance["teacher"] == load_checkpoint(teacher).hash
    assert str(teacher) not in json.dumps(header.provenance)
    if strategy != "adaptive_piecewise":
        assert header.time_grid == uniform_grid(4)
        return
    with np.load(tmp_path / "run" / "selection.npz") as found:
        made = TrajectoryCosts(found["total"], found["optima"]).selection
    assert header.time_grid == made.grid
    assert made.cost <= made.uniform_cost
    assert made.per_trajectory.shape == (3, 3)
    monkeypatch.delattr(selection_module, "sum_costs")  # it is not called again
    call("distill", config, "--resume", "recipe.iterations=14")
    assert (
        read_header(tmp_path / "run" / "run.safetensors")[0].time_grid
        == header.time_grid
    )


def distilling(scans: Path, folder: Path, teacher: Path) -> Path:
    selection = {"candidates": 10, "trajectories": 3}
    recipe = {"metric": "pseudo_huber", "iterations": 4}
    return write_config(
        scans, folder, teacher=str(teacher), steps=2, selection=selection, recipe=recipe
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("intervals=3", "intervals=4"),
        ("selection.candidates=8", "selection.candidates=10"),
        ("selection.seed=5", "selection.seed=0"),
        ("recipe.metric=squared_l2", "metric='pseudo_huber'"),
        ("precision=bf16", "precision='no'"),
        ("teacher", "teacher='"),
    ],
)
def test_a_selection_of_other_settings_is_refused(
    override: str, named: str, scans: Path, teacher: Path, tmp_path: Path
) -> None:
    config = distilling(scans, tmp_path, teacher)
    call("distill", config)
    run = tmp_path / "run"
    (run / "state.safetensors").unlink()  # stopped before the first save
    if override == "teacher":
        checkpoint = load_checkpoint(teacher)
        header = replace(
            checkpoint.header,
            provenance=checkpoint.header.provenance | {"iterations": 99},
        )
        save_checkpoint(tmp_path / "other.safetensors", header, checkpoint.networks)
        override = f"teacher={tmp_path / 'other.safetensors'}"
    before = (run / "config.yaml").read_bytes()
    with pytest.raises(
        ConfigError, match=rf"selection.npz, which was made with .*{re.escape(named)}"
    ):
        call("distill", config, override)
    assert (run / "config.yaml").read_bytes() == before


def test_a_run_is_resumed_with_another_licence_and_spelling_of_a_path(
    scans: Path, tmp_path: Path
) -> None:
    config = write_config(scans, tmp_path)
    call("train", config, "--minutes", "0")
    same = scans / ".." / scans.name / "scans"
    given = ("licence=MIT-0", "data.licence=MIT-0", f"data.path={same}")
    call("train", config, "--resume", *given)
    facts = read_header(tmp_path / "run" / "run.safetensors")[0].provenance
    assert facts["licence"] == facts["data_licence"] == "MIT-0"


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("seed=3", r"seed=3 \(it began with 0\)"),
        ("recipe.metric=l1", r"recipe.metric='l1' \(it began with 'squared_l2'\)"),
        ("recipe.rate=1e-3", r"recipe.rate=0.001 \(it began with 0.01\)"),
        (
            "recipe.weights={range: 2}",
            r"recipe.weights.range=2.0 \(it began with None\)",
        ),
        ("data.flip=false", r"data.flip=False \(it began with True\)"),
        ("precision=bf16", r"precision='bf16' \(it began with 'no'\)"),
        ("timesteps=u_shaped", r"timesteps='u_shaped' \(it began with 'uniform'\)"),
    ],
)
def test_a_run_is_not_resumed_with_other_settings(
    override: str, named: str, scans: Path, tmp_path: Path
) -> None:
    config = write_config(scans, tmp_path)
    call("train", config, "--minutes", "0")
    files = [
        tmp_path / "run" / name
        for name in ("config.yaml", "state.safetensors", "run.safetensors")
    ]
    before = [file.read_bytes() for file in files]
    with pytest.raises(ConfigError, match=f"--resume of .*run with .*{named}"):
        call("train", config, "--resume", override)
    assert [file.read_bytes() for file in files] == before


@pytest.mark.slow
def test_a_run_is_resumed_with_more_iterations_and_what_changes_no_result(
    scans: Path, tmp_path: Path
) -> None:
    config = write_config(scans, tmp_path)
    call("train", config, "--minutes", "0")
    harmless = [
        "save_every=7",
        "samples.every=9",
        "samples.count=2",
        "gradient_checkpointing=true",
    ]
    call("train", config, "--resume", "recipe.iterations=14", *harmless)
    assert (
        read_header(tmp_path / "run" / "run.safetensors")[0].provenance["iterations"]
        == 14
    )
    with pytest.raises(ConfigError, match=r"recipe.iterations=12 \(it began with 14\)"):
        call("train", config, "--resume")


def test_a_run_is_resumed_with_fewer_iterations_before_its_rate_falls(
    scans: Path, tmp_path: Path
) -> None:
    """It ends as the run that had them from its start."""
    for name in "ab":
        (tmp_path / name).mkdir()
    short, long = (
        write_config(scans, tmp_path / name, recipe={"schedule": "trapezoid"})
        for name in "ab"
    )
    call("train", short)
    call("train", long, "recipe.iterations=1000", "--minutes", "0")
    with pytest.raises(
        ConfigError, match=r"recipe.iterations=1 \(it began with 1000\)"
    ):
        call("train", long, "--resume", "recipe.iterations=1")
    call("train", long, "--resume")
    a, b = (
        load_checkpoint(tmp_path / name / "run" / "run.safetensors") for name in "ab"
    )
    assert a.hash == b.hash
    with pytest.raises(ConfigError, match=r"recipe.iterations=9 \(it began with 12\)"):
        call("train", long, "--resume", "recipe.iterations=9")


def test_a_run_is_not_resumed_with_another_teacher_of_the_same_name(
    scans: Path, teacher: Path, tmp_path: Path
) -> None:
    mine = tmp_path / "teacher.safetensors"
    mine.write_bytes(teacher.read_bytes())
    config = write_config(
        scans,
        tmp_path,
        teacher=str(mine),
        strategy="reflow",
        steps=2,
        recipe={"iterations": 4},
    )
    call("distill", config, "--minutes", "0")
    checkpoint = load_checkpoint(mine)
    header = replace(
        checkpoint.header, provenance=checkpoint.header.provenance | {"iterations": 99}
    )
    save_checkpoint(mine, header, checkpoint.networks)
    with pytest.raises(
        ConfigError,
        match=r"--resume of .*run with teacher='\w+' \(it began with '\w+'\)",
    ):
        call("distill", config, "--resume")


def test_a_run_without_its_configuration_is_not_resumed(
    scans: Path, tmp_path: Path
) -> None:
    config = write_config(scans, tmp_path)
    call("train", config, "--minutes", "0")
    (tmp_path / "run" / "config.yaml").unlink()
    with pytest.raises(FileError, match=r"run/config.yaml cannot be read"):
        call("train", config, "--resume")


def test_a_batch_that_cannot_be_divided_is_refused_before_scans_are_projected(
    scans: Path, tmp_path: Path
) -> None:
    config = write_config(scans, tmp_path)
    with pytest.raises(ConfigError, match="a multiple of 3, such as recipe.batch=6"):
        call("train", config, "recipe.accumulate=3")
    assert not (tmp_path / "run" / "cache").exists()


def test_a_cache_of_other_scans_is_refused(
    scans: Path, teacher: Path, tmp_path: Path
) -> None:
    config = write_config(scans, tmp_path)
    with pytest.raises(ConfigError, match="cache of other data"):
        call(
            "train",
            config,
            f"data.cache={teacher.parent / 'cache'}",
            "data.on_bad=skip",
        )
