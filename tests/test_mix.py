"""The one door: two sources to batches, epochs that follow one another, resumption."""

import warnings
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from banks import SENSOR, some_image, write_bank
from mixtures import Endless, Scans

import lidar_synth
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.formats import WRITERS
from lidar_synth.formats.as_sensor import make_transfer
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.mixing import Linear, MixedScans, MixedStream
from lidar_synth.mixing.batches import MixedBatches
from lidar_synth.mixing.service import BatchMixer
from lidar_synth.mixing.state import make_state

THEIRS = Sensor("theirs", 64, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)
WORKERS = pytest.mark.parametrize(
    "workers",
    [0, pytest.param(2, marks=pytest.mark.slow)],
    ids=["0 workers", "2 workers"],
)


def mixture() -> MixedScans:
    return lidar_synth.mix(Scans("r", 9), Endless(), ratio=Linear(0.5, 0.1, 4), seed=3)


def ids(batches: Any) -> list[str]:
    return [name for batch in batches for name in batch["id"]]


def in_order(epoch: int) -> list[str]:
    train = mixture()
    train.set_epoch(epoch)
    return [train[i]["id"] for i in range(len(train))]


def test_two_folders_are_mixed_by_their_paths(tmp_path: Path) -> None:
    writer = WRITERS["npz"](tmp_path / "real")
    for number, scan in enumerate(Scans("r", 3)):
        writer.write(scan, number)
    writer.finish()
    write_bank(tmp_path / "bank", [some_image(i) for i in range(4)])
    train = lidar_synth.mix(tmp_path / "real", str(tmp_path / "bank"), ratio=0.25)
    [batch] = train.loader(batch_size=4)
    assert sorted(batch["domain"].tolist()) == [0, 0, 0, 1]
    with pytest.raises(FileError, match="no/such"):
        lidar_synth.mix("no/such", tmp_path / "bank")
    with pytest.raises(ConfigError, match="model 'tow'.*town"):
        lidar_synth.mix(tmp_path / "real", "tow")
    with pytest.raises(DataError, match="a source without scans"):
        lidar_synth.mix([], tmp_path / "bank")


def test_synthetic_scans_come_out_on_the_sensor_of_the_real_ones() -> None:
    real = Scans("r", 4, sensor=THEIRS)
    town = lidar_synth.Town(seed=0, scans=2, sensor=SENSOR)
    train = lidar_synth.mix(
        real, town, ratio=0.5, to_sample=lambda scan, rng: scan.sensor.shape
    )
    assert [train[i] for i in range(len(train))] == [THEIRS.shape] * 8
    with pytest.raises(ConfigError, match="8 x 64"):
        lidar_synth.mix(real, town, ratio=0.5, as_sensor=None)
    alone = lidar_synth.mix(None, town, ratio=1.0, epoch_size=4)
    assert len(alone) == 4 and alone[0]["domain"] == 1
    same = lidar_synth.mix(Scans("r", 4), Endless(), ratio=0.5)
    assert same.mixture == MixedScans(Scans("r", 4), Endless(), ratio=0.5).mixture


@pytest.mark.parametrize("alike", [True, False], ids=["same lasers", "others"])
def test_synthetic_scans_of_other_lasers_get_the_reflectance_of_the_real_ones(
    alike: bool,
) -> None:
    town = lidar_synth.Town(seed=0, scans=4, sensor="town")
    sensor = "hdl64e_semantic_kitti" if alike else "pandar64"
    real = list(lidar_synth.Town(seed=1, scans=4, sensor=sensor))
    for scan in real:
        scan.reflectance = 0.5 + scan.reflectance / 2
    train = lidar_synth.mix(
        real, town, ratio=0.5, to_sample=lambda scan, rng: scan, collate=list
    )
    scans = [train[i] for i in range(len(train)) if train.domain(i)]
    middle = np.median(np.concatenate([scan.reflectance for scan in scans]))
    assert (middle > 0.6) != alike


def test_endless_scans_of_other_lasers_get_the_reflectance_of_the_real_ones() -> None:
    sensor = replace(THEIRS, rows=16)
    real = Scans("r", 4, sensor=sensor)
    train = lidar_synth.mix(real, Endless(), ratio=0.5)
    first = [Endless()[number] for number in range(4)]
    transfer = make_transfer(sensor, (0.0, 0.0), real, first)
    assert train.mixture.synthetic[0].identity.endswith(f" as {transfer.identity}")


@WORKERS
def test_each_pass_of_a_loader_is_the_next_epoch(workers: int) -> None:
    loader = mixture().loader(batch_size=4, num_workers=workers)
    for epoch in range(3):
        assert loader.epoch == epoch
        assert ids(loader) == in_order(epoch)
    loader.set_epoch(7)
    assert ids(loader) == in_order(7)


@WORKERS
@pytest.mark.parametrize("done", [1, 3, None], ids=["early", "late", "whole"])
def test_a_loader_resumes_after_the_latest_batch(
    workers: int, done: int | None
) -> None:
    loader = mixture().loader(batch_size=4, num_workers=workers, drop_last=False)
    loader.set_epoch(2)
    seen = ids(islice(loader, done))
    state = loader.state_dict()
    resumed = mixture().loader(batch_size=2, num_workers=workers)
    resumed.load_state_dict(state)
    whole = in_order(2)
    assert seen == whole[: len(seen)]
    assert len(resumed) == len(whole) // 2  # whole epochs, which trainers count
    assert ids(resumed) == (whole[len(seen) :] or in_order(3))
    assert resumed.epoch == (3 if done else 4)
    assert ids(resumed) == in_order(resumed.epoch - 1)


@WORKERS
@pytest.mark.parametrize("later", [(2,), (3, 2)])
def test_a_resumed_epoch_that_comes_again_is_whole(
    workers: int, later: tuple[int, ...]
) -> None:
    loader = mixture().loader(batch_size=4, num_workers=workers)
    loader.load_state_dict(make_state(mixture().mixture, 2, 4))
    next(iter(loader))  # workers have taken all batches by now; the pass is not over
    assert ids(loader) == in_order(2)[4:]
    for epoch in later:
        loader.set_epoch(epoch)
        assert ids(loader) == in_order(epoch)
        assert loader.epoch == loader.state_dict()["epoch"] == epoch + 1


def test_a_pass_that_is_left_early_is_begun_again() -> None:
    loader = mixture().loader(batch_size=4)
    first = ids(islice(loader, 2))
    assert ids(loader)[: len(first)] == first
    assert loader.epoch == 1


@WORKERS
def test_short_passes_over_the_same_batches_are_warned_about(workers: int) -> None:
    loader = mixture().loader(batch_size=4, num_workers=workers)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "epoch . begins again")
        next(iter(loader))
        for epoch in range(2):
            loader.set_epoch(epoch)
            ids(islice(loader, 2))
        with pytest.raises(UserWarning, match=r"epoch 1 .* set_epoch.* epoch_size=N"):
            next(iter(loader))
        test = MixedScans(Scans("r", 9), ratio=0).loader(batch_size=4)
        assert ids(islice(test, 2)) == ids(islice(test, 2))


def test_a_pass_of_counted_batches_is_followed_by_the_next_epoch() -> None:
    loader = mixture().loader(batch_size=4)
    for epoch in range(3):
        assert ids(
            batch for _, batch in zip(range(len(loader)), loader, strict=False)
        ) == in_order(epoch)
        assert loader.state_dict()["epoch"] == loader.epoch == epoch + 1


def test_the_epoch_of_the_mixture_counts() -> None:
    train = mixture()
    loader = train.loader(batch_size=4)
    ids(islice(loader, 2))
    for epoch in (5, 2):
        train.set_epoch(epoch)
        assert (loader.state_dict()["epoch"], loader.state_dict()["position"]) == (
            epoch,
            0,
        )
        assert ids(loader) == in_order(epoch)
    loader.set_epoch(2)
    assert ids(loader) == in_order(2)


def test_bad_sizes_are_refused() -> None:
    with pytest.raises(ConfigError, match="batch_size 0"):
        mixture().loader(batch_size=0)
    for wrong in ("4", 4.0):
        with pytest.raises(ConfigError, match="batch_size .*; expected a whole number"):
            mixture().loader(batch_size=wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="epoch_size=4.5; expected 'add', 'replace'"):
        MixedScans(Scans("r", 4), Endless(), 0.5, epoch_size=4.5)  # type: ignore[arg-type]


@pytest.mark.parametrize("batched", [BatchMixer, MixedStream, MixedBatches])
def test_batches_of_no_mixture_are_refused(batched: Any) -> None:
    with pytest.raises(ConfigError, match="batches of a list; expected a MixedScans"):
        batched([1, 2], batch_size=2)


def test_sizes_of_numpy_are_taken() -> None:
    train = MixedScans(Scans("r", 4), Endless(), 0.5, epoch_size=np.int64(6))  # type: ignore[arg-type]
    assert len(train.loader(batch_size=np.int64(2))) == 3  # type: ignore[arg-type]
    assert train.plan().hash


def test_an_epoch_without_a_whole_batch_is_refused() -> None:
    train = mixture()
    loader = train.loader(batch_size=len(train) + 1, drop_last=True)
    with pytest.raises(ConfigError, match="18 samples .*drop_last=True; expected 19"):
        next(iter(loader))
    assert len(list(train.loader(batch_size=len(train), drop_last=True))) == 1


@pytest.mark.parametrize("name", ["epoch", "real_as_is"])
def test_an_argument_that_mix_does_not_have_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"argument of mix {name!r}.*'epochs'"):
        lidar_synth.mix(Scans("r", 4), Endless(), **{name: 1})


def test_batches_in_another_order_are_refused() -> None:
    """A state counts batches: it would resume after others than those that came."""
    for order in (
        {"in_order": False},
        {"shuffle": True},
        {"sampler": [1, 0]},
        {"batch_sampler": [[1, 0]]},
    ):
        name = next(iter(order))
        with pytest.raises(ConfigError, match=f"^{name}=.*expected") as caught:
            mixture().loader(batch_size=4, **order)
        for_lightning = "use_distributed_sampler=False" in str(caught.value)
        assert for_lightning == ("sampler" in name)


def test_the_names_of_the_package_are_shown() -> None:
    assert set(lidar_synth.__all__) == set(dir(lidar_synth))
