"""``lidar-synth edit``: what it refuses before it writes, and what it says about losses."""

from pathlib import Path

import numpy as np
import pytest
from box_scenes import car, cast, wall
from layouts import write_all
from typer.testing import CliRunner

from lidar_synth.cli import app
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import open_scans

SCAN = cast([car(12, 0, 0.3), car(-8, 8)], [wall(24, 0, 1.57, length=80)])


@pytest.fixture
def source(tmp_path: Path) -> Path:
    write_all("npz", tmp_path / "in", [SCAN] * 2)
    return tmp_path / "in"


def call(*words: object) -> str:
    return (
        CliRunner()
        .invoke(app, ["edit", *map(str, words)], catch_exceptions=False)
        .output
    )


def files(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {str(path): path.read_bytes() for path in paths}


def test_a_source_is_not_edited_in_place(source: Path) -> None:
    before = files(source)
    with pytest.raises(ConfigError, match="inside of .*; expected a folder outside"):
        call("remove", source, source, "--name", "Car")
    assert files(source) == before


def test_recorded_scans_in_the_folder_stay_as_they_are(
    source: Path, tmp_path: Path
) -> None:
    write_all("npz", tmp_path / "mine", [SCAN])
    before = files(tmp_path / "mine")
    with pytest.raises(ConfigError, match="mine holds files that this command did not"):
        call("remove", source, tmp_path / "mine", "--name", "Car")
    assert files(tmp_path / "mine") == before


def test_a_scan_is_edited_once_in_a_folder_and_by_the_same_call(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    first = ("remove", source, out, "--box", 0, "--scan", 0)
    call(*first)
    before = files(out)
    monkeypatch.chdir(source.parent)
    call("remove", source.name, *first[2:])
    assert files(out) == before
    differs = (
        r"was filled with {'box': \[0\]}; expected {'box': \[1\]}. .*another folder"
    )
    with pytest.raises(ConfigError, match=differs):
        call("remove", source, out, "--box", 1, "--scan", 0)
    assert files(out) == before
    call("move", source, out, "--box", 0, "--at", "14,-6", "--scan", 1)
    assert files(out).items() > before.items()


def test_all_scans_are_edited_once_in_a_folder(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    call("remove", source, out, "--name", "Car")
    before = files(out)
    assert len(before) == 3  # two scans, and one claim for both
    call("remove", source, out, "--name", "Car")
    for other in [("--name", "Car", "--seed", 1), ("--box", 1, "--scan", 1)]:
        with pytest.raises(ConfigError, match=r"was filled with .*another folder"):
            call("remove", source, out, *other)
    assert files(out) == before


def test_a_class_without_a_box_writes_nothing(source: Path, tmp_path: Path) -> None:
    alone = "--name Dragon; expected the class of some box in these scans: Car$"
    for names in [("Dragon",), ("Car", "--name", "Dragon")]:
        with pytest.raises(ConfigError, match=alone):
            call("remove", source, tmp_path / "out", "--name", *names)
    with pytest.raises(ConfigError, match="--box 0 of 2 scans; expected --scan"):
        call("remove", source, tmp_path / "out", "--box", 0)
    assert not (tmp_path / "out").exists()
    with pytest.raises(DataError, match=r"box \[500\]"):
        call("remove", source, tmp_path / "out", "--box", 500, "--scan", 0)
    assert not files(tmp_path / "out")


def test_what_the_format_cannot_hold_is_named(source: Path, tmp_path: Path) -> None:
    given = ("--box", 0, "--scan", 0, "--to")
    told = call("remove", source, tmp_path / "out", *given, "kitti")
    assert "dropped boxes of 1 scans, which kitti cannot hold" in told
    objects = call("remove", source, tmp_path / "o", *given, "kitti_object")
    assert "dropped boxes outside the camera's view of 1 scans" in objects


@pytest.mark.parametrize(
    "verb", [("move", "--box", 0, "--at", "14,-6"), ("remove", "--box", 0)]
)
def test_scans_are_read_with_the_options_of_other_commands(
    verb: tuple[object, ...], tmp_path: Path
) -> None:
    write_all("kitti_object", tmp_path / "in", [SCAN])
    [path] = (tmp_path / "in").rglob("*.bin")
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    (points * np.float32([1, 1, 1, 255])).tofile(path)
    name, *words = verb
    given = (name, tmp_path / "in", tmp_path / "out", *words, "--scan", 0)
    with pytest.raises(DataError, match="--reflectance-max 255"):
        call(*given)
    call(*given, "--reflectance-max", 255, "--sensor", SCAN.sensor.name)
    edited = open_scans(tmp_path / "out")[0]
    assert edited.sensor == SCAN.sensor and edited.reflectance.max() <= 1


def test_scans_that_cannot_be_read_are_left_out_on_request(
    source: Path, tmp_path: Path
) -> None:
    first, *_ = sorted(source.rglob("*.npz"))
    first.write_bytes(b"PK")
    given = ("remove", source, tmp_path / "out", "--name", "Car")
    assert "1 scans written, 0 were there already, 1 skipped" in call(
        *given, "--on-bad", "skip"
    )
    [name] = open_scans(tmp_path / "out").ids
    assert name == open_scans(source).ids[1]
