"""What a format cannot hold is named, once for each field, and refused on request."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_scenes import car, cast
from conversions import app
from layouts import WRITTEN_AS, some_boxes, some_scan, write_all
from roundtrips import back, same
from test_write_then_read import complete
from typer.testing import CliRunner

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import WRITERS, open_scans
from lidar_synth.formats.convert import convert
from lidar_synth.formats.writer import DETAILS
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.geometry.sensor import presets


def with_image(folder: Path) -> Scan:
    """A scan with everything that a scan can have."""
    from PIL import Image

    Image.new("RGB", (700, 260)).save(folder / "image.png")
    return replace(complete(), image_path=folder / "image.png")


@pytest.mark.parametrize("to", WRITERS)
def test_what_a_format_cannot_hold_is_counted_and_refused_on_request(
    to: str, tmp_path: Path
) -> None:
    scans = [with_image(tmp_path)] * 2
    report = convert(scans, WRITERS[to](tmp_path / "out"), progress=False)  # type: ignore[call-arg]
    assert report.written == 2 and set(report.lost.values()) <= {2}
    found = back(to, tmp_path / "out")[0]
    has = {name for name in DETAILS if getattr(found, name) is not None}
    assert has == set(DETAILS) - set(report.lost)
    strict = WRITERS[to](tmp_path / "strict")  # type: ignore[call-arg]
    with pytest.raises(
        ConfigError,
        match=f"has .*{next(iter(report.lost))}.* cannot hold.*npz or webdataset",
    ):
        convert(scans, strict, on_bad="skip", strict=True, progress=False)
    assert not [path for path in (tmp_path / "strict").rglob("*") if path.is_file()]


@pytest.mark.parametrize("to", [to for to in WRITERS if to != "kitti_object"])
def test_scans_without_labels_gain_none(to: str, tmp_path: Path) -> None:
    scan = replace(some_scan(), label=None, raw_label=None, instance=None)
    report = convert([scan], WRITERS[to](tmp_path), progress=False)  # type: ignore[call-arg]
    found = back(to, tmp_path)[0]
    # A trainer takes a missing label file of SemanticKITTI for a class: it is written, and named.
    assert (
        (found.label is not None)
        == (report.unlabelled == 1)
        == (WRITTEN_AS[to] == "semantic_kitti")
    )


@pytest.mark.parametrize("to", ["pcd", "ply", "mcap"])
def test_boxes_stand_beside_clouds(to: str, tmp_path: Path) -> None:
    scan = replace(
        some_scan(),
        boxes=replace(
            some_boxes(), occlusion=np.arange(5) % 3, dont_care=np.ones((2, 4))
        ),
    )
    [path] = write_all(to, tmp_path, [scan])
    found = back(to, tmp_path)[0].boxes
    assert found is not None and scan.boxes is not None
    assert all(
        same(getattr(found, name), value) for name, value in vars(scan.boxes).items()
    )
    beside = path.with_suffix(".boxes.json")
    numbered = beside.read_text().replace('"names": [', '"names": [1, ')
    for text in (
        "[",
        "[]",
        '{"values": []}',
        numbered,
        '{"values": 1, "names": ["Car"]}',
    ):
        beside.write_text(text)
        with pytest.raises(DataError, match=r"boxes\.json"):
            open_scans(tmp_path)[0]


def test_the_command_prints_a_line_for_each_field(tmp_path: Path) -> None:
    write_all("npz", tmp_path / "in", [complete()] * 3)
    call = [str(tmp_path / "in"), str(tmp_path / "out"), "--to", "kitti"]
    result = CliRunner().invoke(app, [*call, "--strict"])
    assert isinstance(result.exception, ConfigError)
    result = CliRunner().invoke(app, call)
    for name in ("ring", "confidence", "time", "boxes", "pose"):
        assert (
            result.output.count(f"dropped {name} of 3 scans, which kitti cannot hold")
            == 1
        )


def test_boxes_in_which_the_other_sensor_sees_nothing_are_left_out(
    tmp_path: Path,
) -> None:
    near = car(9, 2)
    far = car(11, -60)
    scan = cast([near])
    scan.boxes = Boxes(np.array([near, far]), ("Car", "Van"))
    convert(
        [scan],
        WRITERS["npz"](tmp_path),
        as_sensor=presets()["hdl32e_nuscenes"],
        progress=False,
    )
    found = open_scans(tmp_path)[0].boxes
    assert (
        found is not None
        and found.names == ("Car",)
        and np.allclose(found.values[0], near)
    )


@pytest.mark.parametrize(
    ("to", "change", "lost"),
    [
        ("range", {"points": 2}, "points without a cell of their own"),
        ("png", {"points": 2}, "points without a cell of their own"),
        ("kitti360", {"names": ("Pkw",)}, "names of boxes"),
        ("kitti360", {"label": "motorcyclist"}, "classes of points"),
    ],
)
def test_what_a_format_changes_is_counted_and_refused_on_request(
    to: str, change: dict[str, Any], lost: str, tmp_path: Path
) -> None:
    fine = cast([car(12, 0)])
    fine.label = np.full(len(fine), TRAIN_ID["road"], np.uint8)
    spoilt = fine
    if "points" in change:
        spoilt = fine[np.repeat(np.arange(len(fine)), change["points"])]
    if "names" in change:
        spoilt = replace(fine, boxes=replace(fine.boxes, names=change["names"]))
    if "label" in change:
        label = np.full(len(fine), TRAIN_ID[change["label"]], np.uint8)
        spoilt = replace(fine, label=label)
    report = convert([fine, spoilt], WRITERS[to](tmp_path / "out"), progress=False)
    assert report.lost[lost] == 1
    with pytest.raises(ConfigError, match=f"has .*{lost}"):
        convert([spoilt], WRITERS[to](tmp_path / "s"), strict=True, progress=False)


@pytest.mark.parametrize("name", ["traffic cone", "DontCare"])
def test_a_box_that_kitti_cannot_name_leaves_no_file(name: str, tmp_path: Path) -> None:
    scan = cast([car(12, 0)])
    scan = replace(scan, boxes=replace(scan.boxes, names=(name,)))
    with pytest.raises(DataError, match=f"boxes called .'{name}'.*names of one word"):
        WRITERS["kitti_object"](tmp_path).write(scan, 0)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_boxes_outside_the_camera_are_counted_and_refused_on_request(
    tmp_path: Path,
) -> None:
    scan = cast([car(12, 0), car(-12, 0)])
    report = convert([scan], WRITERS["kitti_object"](tmp_path / "out"), progress=False)
    lost = "boxes outside the camera's view"
    assert report.lost[lost] == 1 and len(open_scans(tmp_path / "out")[0].boxes) == 1
    ahead = replace(scan, boxes=scan.boxes[[0]], label=None, instance=None, ring=None)
    assert lost not in WRITERS["kitti_object"](tmp_path).loses(ahead, None)
    with pytest.raises(ConfigError, match=lost):
        convert(
            [scan],
            WRITERS["kitti_object"](tmp_path / "strict"),
            strict=True,
            progress=False,
        )


@pytest.mark.parametrize("to", ["semantic_kitti", "kitti360", "kitti_object", "npz"])
def test_drives_that_become_one_are_named(to: str, tmp_path: Path) -> None:
    for name in ("002/00", "011/00"):
        WRITERS["npz"](tmp_path / "in").write(some_scan(), 0, name=name)
    for kept in (0, 2):
        writer = WRITERS[to](tmp_path / to)  # type: ignore[call-arg]
        report = convert(open_scans(tmp_path / "in"), writer, progress=False)
        joined = "the limits of drives: several become one" in report.left_out
        assert report.kept == kept and joined == (to in ("semantic_kitti", "kitti360"))
