"""``lidar-synth bank as-sensor``: a bank of the scans of another sensor, made once; settings that
name the sensor."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from banks import write_bank
from blocks import record
from test_transfer_mixing import OURS, THEIRS

from lidar_synth.bake.as_sensor import turn_bank
from lidar_synth.bake.verify import job_of, verify
from lidar_synth.bank import INDEX, Bank
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.files.disk import read_file
from lidar_synth.formats import WRITERS
from lidar_synth.formats.as_sensor import read_transfer
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.transfer import Measurement, Mount, Transfer
from lidar_synth.mixing.settings import mix_for_trainer
from lidar_synth.noise import keyed_rng

TRANSFER = Transfer(THEIRS, Mount(0.1), Measurement(range_noise=0.02, loss=0.1))


@pytest.fixture(scope="module")
def bank(tmp_path_factory: pytest.TempPathFactory) -> Bank:
    """Three scans in shards of two."""
    root = tmp_path_factory.mktemp("banks") / "ours"
    write_bank(root, [project(record(OURS, at=float(i))) for i in range(3)])
    return Bank(root)


def contents(root: Path) -> dict[str, bytes]:
    return {path.name: read_file(path) for path in root.iterdir()}


class Stops(Transfer):
    """Ctrl-C at the third scan."""

    def __call__(self, scan: Scan, *others: object) -> object:  # type: ignore[override]
        if "shard-00001" in scan.id:
            raise KeyboardInterrupt
        return super().__call__(scan, *others)  # type: ignore[arg-type]


def test_a_bank_holds_what_its_transfer_gives(bank: Bank, tmp_path: Path) -> None:
    index = turn_bank(bank, tmp_path, TRANSFER, progress=False)
    turned = Bank(tmp_path)
    assert (index.scans, turned.sensor, turned.fields, list(turned.ids)) == (
        3,
        THEIRS,
        bank.fields,
        list(bank.ids),
    )
    for i in range(3):
        expected = project(TRANSFER(bank[i], keyed_rng(5, i)))
        assert expected.mask.sum() > 1000
        encoding = turned.facts.encoding
        image = turned.image(i)
        expected = encoding.decode(encoding.encode(expected))
        assert np.array_equal(image.range, expected.range) and np.array_equal(
            image.label, expected.label
        )
    assert verify(tmp_path, progress=False) == []
    with pytest.raises(
        DataError, match="turned into scans of 'theirs'.*bank as-sensor again"
    ):
        job_of(turned.facts)


def test_an_interrupted_run_resumes_and_damage_is_made_again(
    bank: Bank, tmp_path: Path
) -> None:
    whole = tmp_path / "whole"
    out = tmp_path / "out"
    turn_bank(bank, whole, TRANSFER, progress=False)
    stops = Stops(TRANSFER.target, TRANSFER.mount, TRANSFER.measurement)
    with pytest.raises(KeyboardInterrupt):
        turn_bank(bank, out, stops, progress=False)
    first = out / "shard-00000.h5"
    written = first.stat().st_ino
    assert not (out / INDEX).exists() and not list(out.glob(".*.part"))
    turn_bank(bank, out, TRANSFER, progress=False)
    assert first.stat().st_ino == written
    shards = {
        name: data
        for name, data in contents(whole).items()
        if name.endswith((".h5", INDEX))
    }
    first.write_bytes(first.read_bytes()[:-50])
    turn_bank(bank, out, TRANSFER, progress=False)
    assert {name: contents(out)[name] for name in shards if name != INDEX} == {
        name: data for name, data in shards.items() if name != INDEX
    }
    assert Bank(out).index.shards == Bank(whole).index.shards
    with pytest.raises(ConfigError, match="was filled with"):
        turn_bank(bank, out, Transfer(THEIRS), progress=False)
    with pytest.raises(ConfigError, match="holds another bank"):
        turn_bank(bank, Path(bank.root), TRANSFER, progress=False)


def test_settings_name_sensor_mount_and_scans_to_match(
    tmp_path: Path, bank: Bank
) -> None:
    writer = WRITERS["npz"](tmp_path / "real")
    bright = record(THEIRS)
    writer.write(
        replace(bright, reflectance=np.clip(bright.reflectance * 2, 0, 1), id="0"), 0
    )
    writer.finish()
    values = THEIRS.to_dict()
    (tmp_path / "theirs.yaml").write_text(yaml.safe_dump({values.pop("name"): values}))
    given = {
        "sensor": str(tmp_path / "theirs.yaml"),
        "mount": [0.1, 0],
        "like": str(tmp_path / "real"),
    }
    matched = read_transfer(given, bank)
    assert matched.mount == Mount(0.1) and matched.target == THEIRS
    assert (
        abs(np.median(matched(bank[0]).reflectance) - np.median(bright.reflectance * 2))
        < 0.05
    )
    for wrong in ({"mount": [0, 0]}, given | {"mount": "high"}, given | {"noise": 1}):
        with pytest.raises(
            ConfigError, match="as_sensor: .*expected sensor: a preset's name"
        ):
            read_transfer(wrong, bank)
    points = np.column_stack([bright.points, bright.reflectance * 255]).astype("<f4")
    (tmp_path / "bytes").mkdir()
    points.tofile(tmp_path / "bytes" / "0.bin")
    with pytest.raises(DataError, match=r"convert .*bytes OUT --to npz --sensor"):
        read_transfer(given | {"like": str(tmp_path / "bytes")}, bank)
    plain = mix_for_trainer(
        3,
        {"synthetic": bank, "as_sensor": {"sensor": "os1_128", "mount": [0.1, 0]}},
        lambda scan, rng: scan,
    )
    made = [
        sample
        for sample in map(plain.__getitem__, range(len(plain)))
        if isinstance(sample, Scan)
    ]
    assert made and all(scan.sensor.name == "os1_128" for scan in made)


def test_what_scans_of_a_sensor_will_lack_is_said_once(
    bank: Bank, caplog: pytest.LogCaptureFixture
) -> None:
    transfer = Transfer(replace(THEIRS, name="wide", fov_up=12.0, fov_down=-31.0))
    with caplog.at_level(logging.WARNING):
        transfer(bank[0])
        transfer(bank[1])
    [message] = [record.getMessage() for record in caplog.records]
    assert (
        "as 'wide': 6 of its 16 lasers look outside" in message
        and "like=FOLDER" in message
    )
