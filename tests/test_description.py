"""Outputs name their sensor, grid and origin: inside their files, or in ``scans.json`` beside
them."""

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from banks import some_image, write_bank
from layouts import MAKERS, WRITTEN_AS, some_scan, write_all

from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import READERS, WRITERS, open_scans
from lidar_synth.formats.convert import convert
from lidar_synth.formats.description import (
    FORMAT,
    LINE,
    NAME,
    Description,
    Origin,
    record,
)
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import REAL, SYNTHETIC, Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor, presets
from lidar_synth.lab.town import LAYOUTS, Town, export_town

SENSORS = {
    "preset": load_sensor("os1_128"),
    "beams": load_sensor("hdl64e_kitti360"),
    "own": Sensor(
        "own one",
        48,
        0.9,
        120.0,
        elevations=(15.0, 7.5, 2.0, -1.0, -9.0, -24.5),
        description="two  spaces ö",
    ),
}

ORIGINS = {
    "real": Origin(),
    "town": Origin(SYNTHETIC, {"made_by": "town", "seed": 5, "interval": 0.4}),
    "model": Origin(
        SYNTHETIC,
        {"made_by": "model", "model": "a b", "checkpoint": "c" * 64, "seed": 2**63 - 1},
    ),
}

BESIDE = ("kitti", "semantic_kitti", "kitti_object", "kitti360")
"""The formats whose files have no room for a description."""

IMAGES = ("range", "png", "cosmos")


def a_scan(
    sensor: Sensor = SENSORS["preset"], origin: Origin = ORIGINS["town"], seed: int = 0
) -> Scan:
    """A scan of this sensor and origin, with labels, boxes and pose."""
    scan = some_scan(seed, sensor.name if sensor.name in presets() else "hdl64e_kitti")
    return replace(
        scan, sensor=sensor, domain=origin.domain, provenance=origin.provenance
    )


def files(root: Path) -> dict[str, bytes]:
    return {
        p.relative_to(root).as_posix(): p.read_bytes()
        for p in sorted(root.rglob("*"))
        if p.is_file()
    }


@pytest.mark.parametrize("origin", ORIGINS.values(), ids=list(ORIGINS))
@pytest.mark.parametrize("sensor", SENSORS.values(), ids=list(SENSORS))
@pytest.mark.parametrize("to", WRITERS)
def test_what_is_written_is_read_without_arguments(
    tmp_path: Path, to: str, sensor: Sensor, origin: Origin
) -> None:
    paths = write_all(to, tmp_path, [a_scan(sensor, origin, seed) for seed in range(2)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        source = open_scans(tmp_path)
        assert type(source) is READERS[WRITTEN_AS[to]] and source.sensor == sensor
        for scan in source:
            assert scan.sensor == sensor and Origin.of(scan) == origin
        if paths[0].is_file():
            assert (
                open_scans(paths[0])[0].sensor == sensor
                and Origin.of(open_scans(paths[0])[0]) == origin
            )
    assert (tmp_path / NAME).is_file() == (to in BESIDE)


@pytest.mark.parametrize("first", WRITERS)
def test_conversions_keep_sensor_and_origin(tmp_path: Path, first: str) -> None:
    chain = [first, *(name for name in WRITERS if name != first)]
    # Images have no boxes, which kitti_object needs.
    chain.sort(key=lambda name: name != first and name in IMAGES)
    scan = a_scan()
    write_all(first, tmp_path / "0", [scan])
    if first != "kitti_object":
        chain.remove("kitti_object")
    for i, to in enumerate(chain[1:]):
        source = open_scans(tmp_path / str(i))
        assert (
            convert(source, WRITERS[to](tmp_path / str(i + 1)), progress=False).written
            == 1
        )
        read = open_scans(tmp_path / str(i + 1))
        assert read.sensor == scan.sensor and Origin.of(read[0]) == ORIGINS["town"], to


def test_a_bank_names_its_model_and_seed(tmp_path: Path) -> None:
    bank = write_bank(tmp_path / "bank", [some_image(i) for i in range(2)])[0].parent
    made = {"made_by": "model", "model": "small", "checkpoint": "c" * 64, "seed": 5}
    assert [scan.provenance for scan in open_scans(bank)] == [made] * 2
    convert(open_scans(bank), WRITERS["kitti"](tmp_path / "out"), progress=False)
    assert open_scans(tmp_path / "out")[1].provenance == made
    convert(
        open_scans(bank),
        WRITERS["npz"](tmp_path / "other"),
        as_sensor=SENSORS["own"],
        progress=False,
    )
    read = open_scans(tmp_path / "other")
    assert read.sensor == SENSORS["own"] and read[0].provenance == made


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_town_of_any_sensor_is_read_as_what_it_is(
    tmp_path: Path, layout: str
) -> None:
    """With the layout's own sensor, an image of 128 x 1024 cells lost half of them without a
    warning."""
    sensor = Sensor("wide", 256, 0.5, 170.0, rows=48, fov_up=22.5, fov_down=-22.5)
    export_town(
        Town(3, sensor, 1), tmp_path / "town", layout, camera=False, progress=False
    )
    source = open_scans(tmp_path / "town")
    expected = Town(3, sensor, 1)[0]
    assert source.sensor == sensor and Origin.of(source[0]) == Origin.of(expected)
    convert(source, WRITERS["range"](tmp_path / "range"), progress=False)
    read = open_scans(tmp_path / "range")
    image = read.image(0)  # type: ignore[attr-defined]
    assert np.array_equal(image.range, project(expected).range)


@pytest.mark.parametrize("to", BESIDE)
def test_a_scan_on_another_grid_is_refused(tmp_path: Path, to: str) -> None:
    write_all(to, tmp_path, [a_scan()])
    before = files(tmp_path)
    message = (
        r"sensor 'hdl64e_kitti360' \(64 x 1024\) for .* 'os1_128' \(128 x 1024\).*"
        r"--as-sensor os1_128"
    )
    for index in (0, 1):
        with pytest.raises(ConfigError, match=message):
            WRITERS[to](tmp_path).write(a_scan(SENSORS["beams"]), index)
    assert files(tmp_path) == before
    WRITERS[to](tmp_path).write(
        a_scan(replace(SENSORS["preset"], name="the same grid", range_max=120.0)), 1
    )


def test_a_conversion_into_a_folder_of_another_grid_leaves_nothing_behind(
    tmp_path: Path,
) -> None:
    write_all("kitti", tmp_path / "out", [a_scan()])
    write_all("npz", tmp_path / "in", [a_scan(SENSORS["beams"])])
    before = files(tmp_path / "out")
    with pytest.raises(ConfigError, match="holds files that this command did not"):
        convert(
            open_scans(tmp_path / "in"),
            WRITERS["kitti"](tmp_path / "out"),
            on_bad="skip",
            progress=False,
        )
    assert files(tmp_path / "out") == before


def test_a_folder_of_several_origins_lists_all_of_them(tmp_path: Path) -> None:
    names = ["town", "real", "model"]
    scans = [a_scan(origin=ORIGINS[name], seed=i) for i, name in enumerate(names * 2)]
    convert(scans, WRITERS["kitti"](tmp_path / "in"), progress=False)
    read = open_scans(tmp_path / "in")
    assert read.description is not None and read.description.origins == tuple(
        ORIGINS[name] for name in names
    )
    assert {scan.domain for scan in read} == {REAL} and read[0].provenance == {}
    synthetic = [scan for scan in scans if scan.domain == SYNTHETIC]
    convert(synthetic, WRITERS["kitti"](tmp_path / "other"), progress=False)
    assert {scan.domain for scan in open_scans(tmp_path / "other")} == {SYNTHETIC}


def test_writers_of_several_processes_add_their_origins(tmp_path: Path) -> None:
    writers = [WRITERS["kitti"](tmp_path) for _ in ORIGINS]
    for index, (writer, origin) in enumerate(
        zip(writers, ORIGINS.values(), strict=True)
    ):
        writer.write(a_scan(origin=origin), index)
    writers[0].write(a_scan(origin=ORIGINS["town"]), 3)
    description = open_scans(tmp_path).description
    assert description is not None and description.origins == tuple(ORIGINS.values())


@pytest.mark.parametrize("to", [name for name in WRITERS if name not in IMAGES])
def test_a_sensor_that_the_user_names_is_taken_with_a_warning(
    tmp_path: Path, to: str
) -> None:
    write_all(to, tmp_path, [a_scan()])
    with pytest.warns(
        UserWarning,
        match="are of sensor 'os1_128'; they are read as those of 'hdl64e_kitti360'",
    ):
        source = open_scans(tmp_path, sensor="hdl64e_kitti360")
    assert (
        source.sensor == source[0].sensor == SENSORS["beams"]
        and source[0].provenance == ORIGINS["town"].provenance
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        named = replace(SENSORS["preset"], name="mine")
        assert open_scans(tmp_path, sensor=named)[0].sensor == named


@pytest.mark.parametrize("to", IMAGES)
def test_range_images_stay_on_their_grid(tmp_path: Path, to: str) -> None:
    write_all(to, tmp_path, [a_scan()])
    with pytest.raises(
        DataError, match="made for sensor 'os1_128', not for 'hdl64e_kitti360'"
    ):
        open_scans(tmp_path, sensor="hdl64e_kitti360")[0]


GOOD = Description(SENSORS["own"], (ORIGINS["model"], ORIGINS["real"])).to_dict()
ONE = {"domain": "synthetic", "seed": 1}

HOSTILE: dict[str, Any] = {
    "list": [],
    "number": 5,
    "empty": {},
    "another format": GOOD | {"format": "lidar-synth-scans/2"},
    "format of a wrong type": GOOD | {"format": ["lidar-synth-scans/1"]},
    "sensor that is a path": GOOD | {"sensor": "/etc/passwd"},
    "sensor of a wrong type": GOOD | {"sensor": 5},
    "sensor without columns": GOOD | {"sensor": {"name": "x"}},
    "sensor with too many cells": GOOD
    | {"sensor": GOOD["sensor"] | {"columns": 1 << 40}},
    "another grid": GOOD | {"grid": [64, 1024]},
    "grid of a wrong type": GOOD | {"grid": {"rows": 6}},
    "origins of a wrong type": GOOD | {"origins": {"domain": "real"}},
    "no origin": GOOD | {"origins": []},
    "unknown domain": GOOD | {"origins": [{"domain": "fake"}]},
    "domain of a wrong type": GOOD | {"origins": [{"domain": []}]},
    "nested provenance": GOOD | {"origins": [ONE | {"data": {"a": 1}}]},
    "long provenance": GOOD | {"origins": [ONE | {"data": "x" * 1001}]},
    "large provenance": GOOD | {"origins": [ONE | {f"key {i}": i for i in range(40)}]},
    "NaN in the provenance": GOOD | {"origins": [ONE | {"seed": float("nan")}]},
    "infinite provenance": GOOD | {"origins": [ONE | {"seed": float("inf")}]},
}


@pytest.mark.parametrize("values", HOSTILE.values(), ids=list(HOSTILE))
def test_a_damaged_description_is_refused(tmp_path: Path, values: Any) -> None:
    write_all("kitti", tmp_path / "in", [a_scan()])
    (tmp_path / "in" / NAME).write_text(json.dumps(values))
    for options in ({}, {"sensor": "os1_128"}):
        with pytest.raises(
            DataError,
            match=f"{NAME}: .*; expected a description.* or yours.* and name",
        ):
            open_scans(tmp_path / "in", **options)  # type: ignore[arg-type]
    with pytest.raises(DataError, match=f"{NAME}.*; expected a desc.* Restore it"):
        WRITERS["kitti"](tmp_path / "in").write(a_scan(), 1)


TEXTS = {
    "cut": (b'{"format": "lidar', "a description.* Restore it"),
    "not text": (b"\xff\xfe\x00", "UTF-8 text"),
    "deep": (b"[" * 100_000, "a description.* Restore it"),
    "long": (b" " * (1 << 20) + b"{}", "a description"),
}


@pytest.mark.parametrize(("content", "expected"), TEXTS.values(), ids=list(TEXTS))
def test_a_file_that_is_no_description_is_refused(
    tmp_path: Path, content: bytes, expected: str
) -> None:
    write_all("kitti", tmp_path, [a_scan()])
    (tmp_path / NAME).write_bytes(content)
    with pytest.raises(DataError, match=f"{NAME}.*; expected {expected}"):
        open_scans(tmp_path)


@pytest.mark.parametrize("values", HOSTILE.values(), ids=list(HOSTILE))
@pytest.mark.parametrize(("to", "prefix"), [("pcd", "# "), ("ply", "comment ")])
def test_a_damaged_comment_is_refused(
    tmp_path: Path, to: str, prefix: str, values: Any
) -> None:
    [path] = write_all(to, tmp_path, [a_scan()])
    mark = f"{prefix}lidar_synth ".encode()
    lines = path.read_bytes().split(b"\n")
    first = next(i for i, line in enumerate(lines) if line.startswith(mark))
    kept = [line for line in lines if not line.startswith(mark)]
    text = json.dumps(values, separators=(",", ":")).replace(" ", r"\u0020").encode()
    path.write_bytes(b"\n".join([*kept[:first], mark + text, *kept[first:]]))
    with pytest.raises(DataError, match=f"{path.name}: its description: "):
        open_scans(path)[0]
    path.write_bytes(b"\n".join(kept))
    assert open_scans(path)[0].provenance == {}


@pytest.mark.parametrize("to", ["pcd", "ply"])
def test_the_lines_of_a_header_are_short(tmp_path: Path, to: str) -> None:
    [path] = write_all(to, tmp_path, [a_scan(SENSORS["beams"])])
    header = (
        path.read_bytes()
        .split({"pcd": b"DATA", "ply": b"end_header"}[to])[0]
        .split(b"\n")
    )
    assert sum(b"lidar_synth" in line for line in header) > 5
    assert max(map(len, header)) <= LINE + 25 and all(line.isascii() for line in header)


@pytest.mark.parametrize("to", ["npz", "range", "png", "webdataset"])
def test_a_damaged_provenance_is_refused(
    tmp_path: Path, to: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Another program's file.
    monkeypatch.setattr(
        "lidar_synth.formats.writer.check_facts", lambda scan, where: None
    )
    origin = Origin(SYNTHETIC, {"seed": {"nested": 1}})
    write_all(to, tmp_path, [a_scan(origin=origin)])
    with pytest.raises(DataError, match="not a short text or a number"):
        open_scans(tmp_path)[0]


def test_users_describe_their_own_folders(tmp_path: Path) -> None:
    MAKERS["kitti_raw"](tmp_path)
    assert open_scans(tmp_path).sensor.name == "hdl64e_kitti"
    (tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync" / NAME).write_text(
        "not beside the root"
    )
    (tmp_path / NAME).write_text(json.dumps({"format": FORMAT, "sensor": "os1_128"}))
    source = open_scans(tmp_path)
    assert source.sensor.name == "os1_128" and Origin.of(source[0]) == Origin()


def test_recording_again_changes_nothing(tmp_path: Path) -> None:
    record(tmp_path, SENSORS["own"], ORIGINS["town"])
    before = (tmp_path / NAME).read_bytes()
    again = record(
        tmp_path, replace(SENSORS["own"], name="another name"), ORIGINS["town"]
    )
    assert (tmp_path / NAME).read_bytes() == before and again.sensor == SENSORS["own"]
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


@pytest.mark.parametrize("to", [name for name in WRITERS if name not in BESIDE])
def test_files_that_describe_themselves_may_differ(tmp_path: Path, to: str) -> None:
    scans = [
        a_scan(origin=origin, seed=seed)
        for seed, origin in enumerate(reversed(ORIGINS.values()))
    ]
    write_all(to, tmp_path, scans)
    assert [Origin.of(scan) for scan in open_scans(tmp_path)] == list(
        reversed(ORIGINS.values())
    )


@pytest.mark.parametrize("to", ["npz", "pcd", "ply", "webdataset", "mcap"])
def test_a_folder_may_hold_files_of_several_sensors(tmp_path: Path, to: str) -> None:
    write_all(to, tmp_path, [a_scan(sensor) for sensor in SENSORS.values()])
    assert [scan.sensor for scan in open_scans(tmp_path)] == list(SENSORS.values())


# --- folders below a description
# ----------------------------------------------------------------------------------


NESTED = ("town/1/0", "town/1/1", "002/00", "a/b/c/d/0")
"""Ids of banks, of PandaSet and of folders, which become names of files."""


def nested(root: Path) -> Path:
    writer = WRITERS["kitti"](root)
    for index, name in enumerate(NESTED):
        writer.write(a_scan(seed=index), index, name=name)
    return root


@pytest.mark.parametrize(
    "part", ["town", "town/1", "town/1/0.bin", "002", "002/00.bin", "a/b/c/d/0.bin"]
)
def test_a_part_of_a_converted_folder_is_what_the_folder_is(
    tmp_path: Path, part: str
) -> None:
    source = open_scans(nested(tmp_path / "out") / part)
    assert (
        source.sensor == SENSORS["preset"] and Origin.of(source[0]) == ORIGINS["town"]
    )


def test_the_nearest_description_counts(tmp_path: Path) -> None:
    (tmp_path / NAME).write_text(json.dumps({"format": FORMAT, "sensor": "vlp16"}))
    assert (
        open_scans(nested(tmp_path / "out") / "town" / "1").sensor == SENSORS["preset"]
    )


@pytest.mark.parametrize(
    "layout", ["kitti360", "semantic_kitti", "kitti_object", "kitti_raw"]
)
def test_a_description_above_a_dataset_says_nothing_about_it(
    tmp_path: Path, layout: str
) -> None:
    nested(tmp_path)
    MAKERS[layout](tmp_path / "real")
    (tmp_path / "real" / NAME).unlink(missing_ok=True)
    for path in (tmp_path / "real", next((tmp_path / "real").rglob("*.bin"))):
        source = open_scans(path)
        assert source.description is None and source[0].domain == REAL


@pytest.mark.parametrize(
    "above", ["kitti", "semantic_kitti", "kitti_object", "kitti360"]
)
def test_a_description_above_a_folder_of_other_scans_says_nothing_about_them(
    tmp_path: Path, above: str
) -> None:
    """Of a dataset's layout, which has no other folders, or of scans that lie in the folder
    itself."""
    write_all(above, tmp_path, [a_scan()])
    write_all("kitti", tmp_path / "own", [some_scan()])
    (tmp_path / "own" / NAME).unlink()
    assert open_scans(tmp_path / "own").description is None


@pytest.mark.parametrize("content", ["[1, 2]", "{", '{"scans": 5}'])
def test_a_file_of_another_program_above_is_no_description(
    tmp_path: Path, content: str
) -> None:
    write_all("kitti", tmp_path / "own", [some_scan()])
    (tmp_path / "own" / NAME).unlink()
    (tmp_path / NAME).write_text(content)
    assert open_scans(tmp_path / "own").description is None
    (tmp_path / NAME).write_text(json.dumps(GOOD)[:-1])
    with pytest.raises(DataError, match=f"{NAME}.*; expected a desc.* Restore it"):
        open_scans(tmp_path / "own")
