"""A bank of one sensor serves the trainer of another: ``MixedScans(as_sensor=...)``."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from blocks import record
from torch.utils.data import DataLoader

from lidar_synth.errors import ConfigError
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.geometry.transfer import Measurement, Mount, Transfer
from lidar_synth.mixing import MixedScans
from lidar_synth.mixing.settings import mix_for_trainer

THEIRS = Sensor("theirs", 512, 1.0, 100.0, rows=16, fov_up=2.0, fov_down=-14.0)
OURS = replace(load_sensor("hdl64e_kitti360"), firings=512)
NOISY = Transfer(THEIRS, Mount(0.1), Measurement(range_noise=0.02, loss=0.1))


@pytest.fixture(scope="module")
def scans() -> tuple[list[Scan], list[Scan]]:
    """Real scans of one sensor and synthetic ones of another."""
    real = [replace(record(THEIRS, at=float(i)), id=f"r{i}") for i in range(4)]
    return real, [replace(record(OURS, at=float(i)), id=f"s{i}") for i in range(3)]


def test_synthetic_scans_become_scans_of_the_real_sensor(
    scans: tuple[list[Scan], list[Scan]],
) -> None:
    real, synthetic = scans
    with pytest.raises(
        ConfigError, match=r"sources of the sensors 'theirs' .* Turn the .*as_sensor"
    ):
        MixedScans(real, synthetic, ratio=0.5)
    train = MixedScans(
        real, synthetic, ratio=0.5, as_sensor=THEIRS, to_sample=lambda scan, rng: scan
    )
    for i in range(len(train)):
        sample = train[i]
        assert sample.sensor == THEIRS and sample.ring is not None
        if train.domain(i):
            expected = Transfer(THEIRS)(synthetic[int(sample.id[1:])])
            assert np.array_equal(sample.points, expected.points)
        else:
            assert np.array_equal(sample.points, real[int(sample.id[1:])].points)


def test_the_settings_of_an_adapter_name_the_sensor(
    scans: tuple[list[Scan], list[Scan]], tmp_path: Path
) -> None:
    values = THEIRS.to_dict()
    path = tmp_path / "theirs.yaml"
    path.write_text(yaml.safe_dump({values.pop("name"): values}))
    mixed = mix_for_trainer(
        3,
        {"synthetic": scans[1], "ratio": 0.5, "as_sensor": str(path)},
        lambda scan, rng: scan,
    )
    made = [
        sample
        for sample in map(mixed.__getitem__, range(len(mixed)))
        if isinstance(sample, Scan)
    ]
    assert len(made) == 3
    for scan in made:
        assert np.array_equal(
            scan.points, Transfer(THEIRS)(scans[1][int(scan.id[1:])]).points
        )


@pytest.mark.parametrize("workers", [0, 2])
def test_noise_depends_on_seed_epoch_and_position_alone(
    scans: tuple[list[Scan], list[Scan]], workers: int
) -> None:
    def epoch(seed: int, number: int, count: int) -> dict[str, torch.Tensor]:
        train = MixedScans(
            *scans, ratio=0.5, seed=seed, as_sensor=NOISY, reuse=2, collate="range"
        )
        train.set_epoch(number)
        [batch] = DataLoader(train, 8, num_workers=count, collate_fn=train.collate)
        assert batch["range"].shape[1:] == THEIRS.shape
        return dict(zip(batch["id"], batch["range"], strict=True))

    first = epoch(0, 1, workers)
    again = epoch(0, 1, 0)
    other = epoch(0, 0, 0)
    assert first.keys() == again.keys() and all(
        torch.equal(first[name], again[name]) for name in first
    )
    shared = {name for name in first.keys() & other.keys() if name.startswith("s")}
    assert shared and not any(torch.equal(first[name], other[name]) for name in shared)


def test_the_plans_hash_tells_the_transfer(
    scans: tuple[list[Scan], list[Scan]],
) -> None:
    hashes = {
        MixedScans(*scans, ratio=0.5, as_sensor=t).plan(0).hash
        for t in (THEIRS, NOISY, Transfer(THEIRS))
    }
    assert len(hashes) == 2


def test_a_trainers_own_dataset_with_scans_of_another_sensor(
    scans: tuple[list[Scan], list[Scan]],
) -> None:
    yours = [torch.from_numpy(scan.points) for scan in scans[0]]
    train = MixedScans.wrap(
        yours,
        scans[1],
        ratio=0.5,
        as_sensor="hdl32e_nuscenes",
        to_sample=lambda scan, rng: torch.from_numpy(scan.points),
    )
    lengths = [len(train[i]) for i in range(len(train)) if train.domain(i)]
    assert max(lengths) < 0.7 * len(scans[1][0])


def test_objects_are_pasted_after_the_transfer(
    scans: tuple[list[Scan], list[Scan]],
) -> None:
    """The label policy gets scans of the target, and of all fields."""
    seen: list[Scan] = []

    def policy(scan: Scan, rng: np.random.Generator) -> Scan:
        seen.append(scan)
        return scan

    train = MixedScans(*scans, ratio=0.5, as_sensor=THEIRS, labels=policy)
    for i in range(len(train)):
        train[i]
    assert seen and all(scan.sensor == THEIRS for scan in seen)
