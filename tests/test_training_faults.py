"""Runs that are disturbed: caches that two of them open, failures while saving, patience that ends
before the rate falls, and starts that contradict the configuration."""

import json
import os
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import random_scan

from lidar_synth.errors import ConfigError, FileError
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.generate.checkpoint import read_header
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.train import (
    Record,
    TrainConfig,
    cache_scans,
    load_config,
    run,
    runs,
)
from lidar_synth.lab.train.held_out import HISTORY, read_history
from lidar_synth.lab.train.schedules import PLATEAU
from lidar_synth.lab.train.staged import train_for
from lidar_synth.lab.train.start import open_networks
from lidar_synth.lab.train.state import read_progress

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
SHORT = (
    "recipe.batch=1",
    "data.town=2",
    "samples.every=0",
    "recipe.warmup=1",
    "save_every=2",
)
HELD = "held_out={data: {licence: MIT, town: 2, seed: 1}, samples: 1, patience: 2}"


def config(folder: Path, *more: str) -> TrainConfig:
    return load_config(TrainConfig, "town_tiny", [*SHORT, f"output={folder}", *more])


class Stopped(list[Scan]):
    """Scans of a run that is stopped before it reads the first one."""

    def __getitem__(self, index: Any) -> Any:
        raise KeyboardInterrupt


def test_a_second_run_does_not_empty_the_cache_of_the_first(tmp_path: Path) -> None:
    class Disturbed(list[Scan]):
        """While the sixth is read, another run opens the cache."""

        def __getitem__(self, index: Any) -> Any:
            if index == 5:
                with pytest.raises(KeyboardInterrupt):
                    cache_scans(
                        Stopped(self), SENSOR, ["range"], tmp_path, progress=False
                    )
            return super().__getitem__(index)

    scans = [random_scan(SENSOR, 100, seed) for seed in range(8)]
    cache = cache_scans(Disturbed(scans), SENSOR, ["range"], tmp_path, progress=False)
    assert all((np.asarray(cache.fields["range"][i]) > 0).any() for i in range(8))


@pytest.mark.slow
@pytest.mark.parametrize("held", [(), (HELD,)], ids=["plain", "held out"])
def test_a_checkpoint_that_could_not_be_written_is_written_by_the_next_run(
    held: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = runs.save_checkpoint

    def full(path: Path, header: Any, networks: Any) -> Any:
        if header.provenance["iterations"] == 4:
            raise FileError(f"{path} cannot be written", "space")
        return save(path, header, networks)

    given = config(tmp_path / "run", "recipe.iterations=4", *held)
    monkeypatch.setattr(runs, "save_checkpoint", full)
    with pytest.raises(FileError, match="cannot be written"):
        run(given)
    monkeypatch.setattr(runs, "save_checkpoint", save)
    again = read_header(run(given, resume=True))[0].provenance
    assert read_progress(tmp_path / "run").step == 4 and again["iterations"] == 4


def test_a_removed_checkpoint_is_written_again(tmp_path: Path) -> None:
    given = config(tmp_path / "run", "recipe.iterations=2")
    made = run(given)
    _, before = read_header(made)
    made.unlink()
    assert read_header(run(given, resume=True))[1] == before


def test_removed_weights_that_were_better_than_the_last_are_missed(
    tmp_path: Path,
) -> None:
    # At this rate the loss grows.
    given = config(tmp_path / "run", "recipe.iterations=2", HELD, "recipe.rate=0.5")
    run(given).unlink()
    with pytest.raises(ConfigError, match="run.safetensors, which is missing; exp"):
        run(given, resume=True)


def test_a_run_that_is_refused_is_not_measured(tmp_path: Path) -> None:
    given = config(tmp_path / "run", "recipe.iterations=4", HELD)
    run(given, minutes=0).unlink()
    # As after Ctrl-C, when the last weights are not measured.
    history = read_history(tmp_path / "run")[:1]
    (tmp_path / "run" / HISTORY).write_text(json.dumps(history))
    with pytest.raises(ConfigError, match="run.safetensors, which is missing; exp"):
        run(given, resume=True)
    assert read_history(tmp_path / "run") == history


@pytest.mark.slow
def test_the_rate_falls_after_a_plateau_that_patience_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates: list[float] = []
    keep = runs._Keeper.keep

    def watched(self: Any, record: Record, last: bool) -> None:
        rates.append(record.rate)
        keep(self, record, last)

    monkeypatch.setattr(runs._Keeper, "keep", watched)
    # At this rate the loss goes up and down, so that patience ends soon.
    given = config(
        tmp_path / "run", HELD, "recipe.rate=0.05", "recipe.schedule=trapezoid"
    )
    train_for(given, 1.0)
    plateau = read_progress(tmp_path / "run").step * PLATEAU
    assert rates[-1] < 0.05 * 0.5 and len(rates) > plateau


@pytest.mark.slow
def test_a_conditional_start_keeps_its_condition_and_takes_other_shares(
    tmp_path: Path,
) -> None:
    first = "condition={kind: semantic, dropout: 0.0}"
    start = run(
        config(
            tmp_path / "start",
            "recipe.iterations=2",
            "channels=[range,reflectance]",
            first,
        )
    )
    assert read_header(start)[0].conditioning == {"semantic": {}}

    def header(condition: str) -> Any:
        more = (
            "channels=[range,reflectance]",
            f"init={start}",
            f"condition={condition}",
        )
        return open_networks(config(tmp_path / "next", *more))[1]

    assert header("{kind: semantic, dropout: 0.5}").conditioning == {
        "semantic": {"dropout": 0.5}
    }
    assert header("{kind: semantic}").conditioning == {"semantic": {}}
    with pytest.raises(
        ConfigError,
        match=r"condition.kind 'layout' for init .*expected that of the model, 'semantic'",
    ):
        header("{kind: layout, dropout: 0.5}")
    with pytest.raises(ConfigError, match="condition.arguments"):
        header("{kind: semantic, arguments: {channels: 77}}")


@pytest.mark.parametrize("channels", [["range"], ["range", "label"]])
def test_a_cache_of_kitti360_depends_on_the_files_of_its_drives_and_channels_alone(
    channels: list[str], tmp_path: Path
) -> None:
    root = tmp_path / "scans"
    writer = WRITERS["kitti360"](root, drive="2013_05_28_drive_0004_sync")
    for seed in range(2):
        writer.write(random_scan(SENSOR, 400, seed), seed)
    writer.finish()

    def cache() -> None:
        source = open_scans(root, split="r2flow/train")
        cache_scans(source, SENSOR, channels, tmp_path / "cache", progress=False)

    cache()
    test = WRITERS["kitti360"](root, drive="2013_05_28_drive_0000_sync")
    test.write(random_scan(SENSOR, 400), 0)
    test.finish()
    for later in ("data_3d_bboxes/train/2013_05_28_drive_0004_sync.xml", "a.ply"):
        (root / later).parent.mkdir(parents=True, exist_ok=True)
        (root / later).write_text("<x/>")
    cache()
    suffixes = ("label", "bin") if "label" in channels else ("bin",)
    for suffix in suffixes:
        changed = next(root.rglob(f"*0004_sync/**/*.{suffix}"))
        before = changed.stat().st_mtime
        os.utime(changed, (0, before + 60))
        with pytest.raises(ConfigError, match=r"cache of other data \(files differ\)"):
            cache()
        os.utime(changed, (0, before))
    next(root.rglob("*0004_sync/**/*.label")).unlink()
    with nullcontext() if channels == ["range"] else pytest.raises(ConfigError):
        cache()
