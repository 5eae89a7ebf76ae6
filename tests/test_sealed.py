"""What a run keeps to resume is sealed: damage is noticed, said, and that part is made again."""

import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from conftest import random_scan
from safetensors.torch import load_file, save_file
from torch import nn

from lidar_synth.errors import ConfigError, DataError, FileError, LidarSynthError
from lidar_synth.files.lock import one_writer
from lidar_synth.files.parsing import read_sealed, seal
from lidar_synth.geometry.normalize import NORMALISATIONS, TensorFormat
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.proof.study import _is_there, read_outcome, to_values
from lidar_synth.lab.proof.trial import TrialOutcome
from lidar_synth.lab.train import (
    TrainConfig,
    cache_latents,
    cache_scans,
    load_config,
    run,
)
from lidar_synth.lab.train.state import (
    STATE,
    Recipe,
    Training,
    checksum_of,
    read_progress,
)

SENSOR = Sensor("tiny", 32, 1.0, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
SCANS = [random_scan(SENSOR, 100, seed) for seed in range(130)]


def flip(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 16
    path.write_bytes(content)


def cut(path: Path, at: int) -> None:
    path.write_bytes(path.read_bytes()[:at])


@pytest.mark.parametrize("damage", [flip, cut])
@pytest.mark.parametrize("file", ["range.npy", "cache.json"])
@pytest.mark.parametrize("at", [5, 200, -3])
def test_a_damaged_cache_is_made_again(
    tmp_path: Path, damage: Callable[[Path, int], None], file: str, at: int
) -> None:
    made = np.array(
        cache_scans(SCANS, SENSOR, ["range"], tmp_path, progress=False).fields["range"]
    )
    damage(tmp_path / file, at)
    with pytest.warns(UserWarning, match="made again"):
        again = cache_scans(SCANS, SENSOR, ["range"], tmp_path, progress=False)
    assert np.array_equal(again.fields["range"], made)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cache_scans(SCANS, SENSOR, ["range"], tmp_path, progress=False)


def test_only_the_damaged_scans_are_made_again(tmp_path: Path) -> None:
    class Counted(list[Any]):
        reads = 0

        def __getitem__(self, index: Any) -> Any:
            self.reads += 1
            return super().__getitem__(index)

    cache_scans(SCANS, SENSOR, ["range"], tmp_path, progress=False)
    flip(tmp_path / "range.npy", -3)  # of the last block: scans 128 and 129
    counted = Counted(SCANS)
    with pytest.warns(UserWarning, match=r"scans 128 to 129 are damaged"):
        cache_scans(counted, SENSOR, ["range"], tmp_path, progress=False)
    assert counted.reads == 2


class Halves(nn.Module):
    """A codec for tests: the tensor itself."""

    shape = (1, 8, 32)

    def encode(self, x: torch.Tensor) -> torch.Tensor:
        return x


@pytest.mark.parametrize("damage", [flip, cut])
@pytest.mark.parametrize("file", ["latents.npy", "cache.json"])
def test_damaged_latents_are_made_again(
    tmp_path: Path, damage: Callable[[Path, int], None], file: str
) -> None:
    cache = cache_scans(SCANS[:3], SENSOR, ["range"], progress=False)
    tensors = TensorFormat(("range",), NORMALISATIONS["r2flow"])
    codec: Any = Halves()
    made = np.array(
        cache_latents(cache, tensors, codec, "cpu", tmp_path, "abc", progress=False)
    )
    damage(tmp_path / "latents-abc" / file, 30)
    with pytest.warns(UserWarning, match="latents-abc.* made again"):
        again = cache_latents(
            cache, tensors, codec, "cpu", tmp_path, "abc", progress=False
        )
    assert np.array_equal(again, made)


def training() -> Training:
    torch.manual_seed(0)
    made = Training(nn.Linear(4, 3), Recipe(iterations=5))
    made.network(torch.ones(1, 4)).sum().backward()
    for optimizer in made.optimizers:
        optimizer.step()
    return made


def test_no_flipped_bit_of_a_state_is_resumed(tmp_path: Path) -> None:
    """Every damaged state is refused, or (damage between the tensors' bytes) holds the same."""
    path = tmp_path / STATE
    made = training()
    made.step = 3
    made.save(path)
    content = path.read_bytes()
    expected = load_file(path)
    rng = Random(0)
    refused = 0
    other = training()
    for _ in range(200):
        changed = bytearray(content)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        try:
            other.load(path)
        except LidarSynthError:
            refused += 1
            continue
        assert other.step == 3
        assert all(
            torch.equal(expected[f"network.{n}"], p)
            for n, p in other.network.state_dict().items()
        )
    assert refused > 180


@pytest.mark.parametrize(
    "name",
    [
        "x",
        "network",
        "network.weight",
        "optimizer.a.b.c",
        "optimizer.0.0",
        "optimizer.9.0.step",
    ],
)
def test_a_state_with_other_names_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / STATE
    tensors = {name: torch.ones(3)}
    facts = {"step": "1", "seconds": "0"}
    save_file(tensors, path, facts | {"checksum": checksum_of(facts, tensors)})
    with pytest.raises(DataError, match=r"is the state of another network"):
        training().load(path)
    save_file({"network.weight": torch.ones(3)}, path)
    with pytest.raises(DataError, match="not a saved state"):
        read_progress(tmp_path)


def test_outcomes_are_sealed(tmp_path: Path) -> None:
    path = tmp_path / "0-000.json"
    outcome = TrialOutcome(
        np.arange(361).reshape(19, 19), [(1, np.eye(19, dtype=np.int64))], [0.5], 2.0
    )
    path.write_bytes(seal(to_values(outcome)))
    assert np.array_equal(read_outcome(path).table, outcome.table)
    assert _is_there(path, read_outcome)
    content = path.read_bytes()
    rng = Random(0)
    for _ in range(300):
        changed = bytearray(content)
        changed[rng.randrange(len(changed))] = rng.randrange(32, 127)
        path.write_bytes(changed)
        if changed != content:
            with pytest.raises(DataError):
                read_outcome(path)
    with pytest.warns(UserWarning, match="made again"):
        assert not _is_there(path, read_outcome)
    assert not path.exists()
    path.write_bytes(seal({"table": "x"}))
    with pytest.raises(DataError, match="the outcome of a training"):
        read_outcome(path)


def test_sealed_values_are_read_back(tmp_path: Path) -> None:
    values = {"a": [1, 2.5, None], "ü": "\ud800"}
    (tmp_path / "a.json").write_bytes(seal(values))
    assert read_sealed(tmp_path / "a.json", "values") == values


def tiny(out: Path, *more: str) -> TrainConfig:
    changes = [
        "recipe.iterations=2",
        "recipe.batch=1",
        "data.town=2",
        "samples.every=0",
        "save_every=1",
    ]
    return load_config(TrainConfig, "town_tiny", [*changes, f"output={out}", *more])


def test_a_run_with_a_damaged_state_begins_anew_and_says_so(tmp_path: Path) -> None:
    expected = load_file(run(tiny(tmp_path / "run")))
    flip(tmp_path / "run" / STATE, -100)
    shutil.copy(tmp_path / "run" / STATE, tmp_path / "damaged")
    (tmp_path / "run" / ".state.safetensors.12345678.part").write_bytes(
        b"of a killed run"
    )
    with pytest.warns(UserWarning, match="begins anew"):
        found = load_file(run(tiny(tmp_path / "run"), resume=True))
    assert all(torch.equal(found[name], tensor) for name, tensor in expected.items())
    assert (tmp_path / "run" / "state.damaged").read_bytes() == (
        tmp_path / "damaged"
    ).read_bytes()
    assert not list((tmp_path / "run").glob(".*.part"))


def test_a_second_run_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with one_writer(tmp_path / "run" / ".lock") as free:
        assert free
        with pytest.raises(ConfigError, match=r"another run is training in"):
            run(tiny(tmp_path / "run"))


@pytest.mark.parametrize("change", ["name", "shape", "steps"])
def test_moments_that_the_next_step_could_not_use_are_refused(
    tmp_path: Path, change: str
) -> None:
    path = tmp_path / STATE
    training().save(path)
    tensors = load_file(path)
    weight = tensors.pop("optimizer.0.0.exp_avg")
    tensors |= {
        "name": {"optimizer.0.0.exp_avg2": weight},
        "shape": {"optimizer.0.0.exp_avg": weight[:0]},
        "steps": {"optimizer.0.0.exp_avg": weight, "optimizer.0.0.step": torch.ones(2)},
    }[change]
    facts = {"step": "1", "seconds": "0"}
    save_file(tensors, path, facts | {"checksum": checksum_of(facts, tensors)})
    with pytest.raises(DataError, match="is the state of another network"):
        training().load(path)


def test_a_state_with_infinite_weights_is_refused(tmp_path: Path) -> None:
    path = tmp_path / STATE
    made = training()
    with torch.no_grad():
        next(made.network.parameters()).fill_(float("inf"))
    made.save(path)
    with pytest.raises(DataError, match="values that are not finite"):
        training().load(path)


def test_a_cache_without_sums_is_made_again(tmp_path: Path) -> None:
    cache_scans(SCANS, SENSOR, ["range"], tmp_path, progress=False)
    path = tmp_path / "cache.json"
    values = json.loads(path.read_bytes())
    del values["checksum"], values["sums"]
    path.write_bytes(seal(values))
    with pytest.warns(UserWarning, match="made again"):
        cache_scans(SCANS, SENSOR, ["range"], tmp_path, progress=False)


def test_a_run_killed_behind_its_state_has_its_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that ends after its last state has nothing left to train, and so to show."""

    def save(self: Training, path: Path) -> None:
        write_state(self, path)
        raise KeyboardInterrupt

    write_state = Training.save
    config = tiny(tmp_path / "run", "samples.every=2", "save_every=2")
    monkeypatch.setattr(Training, "save", save)
    with pytest.raises(KeyboardInterrupt):
        run(config)
    assert len(list((tmp_path / "run" / "samples").glob("*.png"))) == 1


def test_what_a_killed_run_left_of_a_picture_is_removed(tmp_path: Path) -> None:
    part = tmp_path / "run" / "samples" / ".0000006.png.12345678.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(b"of a killed run")
    run(tiny(tmp_path / "run"))
    assert not part.exists()


def test_a_run_where_nothing_may_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(FileError, match=r"run cannot be written"):
        run(tiny(tmp_path / "file" / "run"))
