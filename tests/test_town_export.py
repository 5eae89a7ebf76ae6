"""Export of the town: every layout is read back by the package's readers; an interrupted export
resumes."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile import MARKUP, tags_of

from lidar_synth.cli.view import view
from lidar_synth.errors import ConfigError, FileError
from lidar_synth.formats import KITTI360, KITTIObject, SemanticKITTI, open_scans
from lidar_synth.geometry.scan import REAL, SYNTHETIC, Scan
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.lab.cli.town import town as command
from lidar_synth.lab.town import LAYOUTS, Town, export_town, load_skin
from lidar_synth.lab.town.export import _groups
from lidar_synth.lab.town.returns import ReturnNoise
from lidar_synth.mixing import MixedScans

COUNT = 3


@pytest.fixture(scope="module")
def town() -> Town:
    return Town(seed=5, scans=COUNT)


@pytest.fixture(scope="module")
def scans(town: Town) -> list[Scan]:
    return [town[i] for i in range(COUNT)]


@pytest.fixture(scope="module", params=sorted(LAYOUTS))
def written(
    request: pytest.FixtureRequest, town: Town, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path]:
    root = tmp_path_factory.mktemp(request.param)
    assert export_town(town, root, request.param, camera=False, progress=False) == (
        COUNT,
        0,
    )
    return request.param, root


@pytest.mark.slow
def test_points_are_read_back_bit_for_bit(
    written: tuple[str, Path], scans: list[Scan]
) -> None:
    layout, root = written
    read = open_scans(root, split="train" if layout == "semantic_kitti" else None)
    assert len(read) == COUNT
    for i, scan in enumerate(scans):
        assert np.array_equal(read[i].points, scan.points)
        assert np.array_equal(read[i].reflectance, scan.reflectance)


def test_scans_read_from_an_exported_town_are_synthetic(
    written: tuple[str, Path], tmp_path: Path
) -> None:
    root = written[1]
    read = open_scans(root)
    assert [scan.domain for scan in read] == [SYNTHETIC] * COUNT and read[
        0
    ].domain == SYNTHETIC
    one = next(
        path for path in sorted(root.rglob("*.bin")) if path.parent.name != "labels"
    )
    assert open_scans(one)[0].domain == SYNTHETIC
    view(root, 0, 1, tmp_path / "page.html", None)
    assert '"domain": 1' in (tmp_path / "page.html").read_text().replace(
        '"domain":1', '"domain": 1'
    )
    # a mixture counts every scan of its real source as real
    real = MixedScans(read, ratio=0)
    assert real[0]["domain"] == REAL


def test_labels_are_read_back(written: tuple[str, Path], scans: list[Scan]) -> None:
    layout, root = written
    if layout == "kitti_object":
        pytest.skip("KITTI's object set has no label per point")
    read = open_scans(root)
    for i, scan in enumerate(scans):
        if layout == "semantic_kitti":
            assert np.array_equal(read[i].raw_label, scan.raw_label)
            assert np.array_equal(read[i].label, scan.label)
        else:
            # KITTI-360 has fewer classes: it merges motorcyclists and trunks with other classes.
            assert (read[i].label == scan.label).mean() > 0.97  # type: ignore[union-attr]


def test_poses_are_read_back(written: tuple[str, Path], scans: list[Scan]) -> None:
    layout, root = written
    if layout == "kitti_object":
        pytest.skip("KITTI's object set has no poses")
    for i, scan in enumerate(scans):
        pose = open_scans(root)[i].pose
        assert pose is not None and scan.pose is not None
        assert np.allclose(pose, scan.pose, atol=1e-5)


def test_boxes_are_read_back(written: tuple[str, Path], scans: list[Scan]) -> None:
    layout, root = written
    if layout == "semantic_kitti":
        pytest.skip("SemanticKITTI has no boxes")
    tolerance = 0.02 if layout == "kitti_object" else 1e-3
    for i, scan in enumerate(scans):
        read = open_scans(root)[i].boxes
        boxes = scan.boxes
        assert read is not None and boxes is not None
        # label_2 lists only objects in the image; KITTI-360's reader drops boxes centred beyond the
        # sensor's range.
        near = np.linalg.norm(boxes.values[:, :2], axis=1) < scan.sensor.range_max - 1
        expected = (
            boxes[boxes.truncation >= 0] if layout == "kitti_object" else boxes[near]
        )
        assert len(read) >= len(expected) > 0
        for value, name in zip(expected.values, expected.names, strict=True):
            distance = np.linalg.norm(read.values[:, :3] - value[:3], axis=1)
            match = int(distance.argmin())
            assert distance[match] < 3 * tolerance
            assert np.allclose(read.values[match, 3:6], value[3:6], atol=tolerance)
            if layout == "kitti_object":
                assert read.names[match] == name


def test_kitti_labels_have_occlusion_truncation_and_image_boxes(
    written: tuple[str, Path], scans: list[Scan]
) -> None:
    layout, root = written
    if layout != "kitti_object":
        pytest.skip("only KITTI's object set")
    read = KITTIObject(root)[0].boxes
    boxes = scans[0].boxes
    assert read is not None and boxes is not None
    seen = boxes[boxes.truncation >= 0]
    for i, value in enumerate(seen.values):
        match = int(np.linalg.norm(read.values[:, :3] - value[:3], axis=1).argmin())
        assert read.occlusion[match] == seen.occlusion[i]
        assert np.allclose(read.image_box[match], seen.image_box[i], atol=0.006)
        assert read.truncation[match] == pytest.approx(seen.truncation[i], abs=0.006)


def test_the_calibration_is_read_back(
    written: tuple[str, Path], town: Town, scans: list[Scan]
) -> None:
    _, root = written
    camera = open_scans(root).calibration(0)
    assert camera is not None
    expected, depth = town.calibration.pixels(scans[0].points)
    actual, _ = camera.pixels(scans[0].points)
    ahead = depth > 1
    assert np.allclose(actual[ahead], expected[ahead], atol=0.01)


def test_the_folder_has_a_readme_and_its_settings(written: tuple[str, Path]) -> None:
    layout, root = written
    text = (root / "README.md").read_text()
    assert "synthetic" in text and "not KITTI-360" in text and layout in text
    assert json.loads((root / "town.json").read_text())["seed"] == 5


def test_splits_and_times_of_each_layout_are_written(written: tuple[str, Path]) -> None:
    layout, root = written
    if layout == "kitti360":
        assert (
            len(KITTI360(root, split="r2flow/train"))
            == len(KITTI360(root, split="lidm/train"))
            == COUNT
        )
    if layout == "semantic_kitti":
        assert len(SemanticKITTI(root, split="train")) == COUNT
        times = [
            float(line)
            for line in (root / "sequences" / "00" / "times.txt").read_text().split()
        ]
        assert np.allclose(times, [0, 0.4, 0.8])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("layout", "scan"),
    {"semantic_kitti": "000001.bin", "kitti360": "0000000001.bin"}.items(),
)
def test_an_interrupted_or_extended_export_changes_no_byte(
    layout: str, scan: str, tmp_path: Path, town: Town
) -> None:
    assert export_town(town, tmp_path, layout, camera=False, progress=False) == (
        COUNT,
        0,
    )
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    [lost] = tmp_path.rglob(f"velodyne*/**/{scan}")
    lost.unlink()
    for missing in (1, 0):
        assert export_town(town, tmp_path, layout, camera=False, progress=False) == (
            missing,
            COUNT - missing,
        )
        assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    longer = Town(seed=5, scans=COUNT + 1)
    assert export_town(longer, tmp_path, layout, camera=False, progress=False) == (
        1,
        COUNT,
    )
    poses = [p for p in before if p.name == "poses.txt"]
    assert poses and all(p.read_bytes().startswith(before[p]) for p in poses)


def test_fewer_scans_than_there_are_keep_all_times(tmp_path: Path) -> None:
    times = tmp_path / "sequences" / "00" / "times.txt"
    export_town(
        Town(seed=5, scans=2), tmp_path, "semantic_kitti", camera=False, progress=False
    )
    before = times.read_text()
    assert export_town(
        Town(seed=5, scans=1), tmp_path, "semantic_kitti", camera=False, progress=False
    ) == (0, 1)
    assert times.read_text() == before and len(before.splitlines()) == 2


def test_the_readme_shows_a_sensor_s_name_as_text(tmp_path: Path) -> None:
    sensor = replace(load_sensor("town"), name=MARKUP)
    export_town(Town(5, sensor, 0), tmp_path, "kitti", camera=False, progress=False)
    assert tags_of((tmp_path / "README.md").read_text()) == {
        "h1",
        "p",
        "strong",
        "code",
        "ul",
        "li",
    }


def test_a_folder_that_holds_another_town_is_refused(
    tmp_path: Path, town: Town
) -> None:
    export_town(Town(seed=5, scans=0), tmp_path, "kitti", camera=False, progress=False)
    with pytest.raises(ConfigError, match=r"was filled with .*'seed': 5"):
        export_town(
            Town(seed=6, scans=1), tmp_path, "kitti", camera=False, progress=False
        )


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"skin": "pandar64"}, "'skin': None"),
        ({"motion": False}, "'motion': True"),
        ({"noise": ReturnNoise(range_std=0.03)}, "'noise'"),
    ],
)
def test_a_folder_is_not_continued_by_a_town_whose_scans_differ(
    tmp_path: Path, options: dict[str, Any], named: str
) -> None:
    export_town(Town(5, "pandar64", 0), tmp_path, "kitti", camera=False, progress=False)
    with pytest.raises(ConfigError, match=f"was filled with .*{named}"):
        export_town(
            Town(5, "pandar64", 1, **options),
            tmp_path,
            "kitti",
            camera=False,
            progress=False,
        )


def test_a_folder_is_not_continued_by_a_town_of_other_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = Town(5, "pandar64", 0)
    export_town(before, tmp_path, "kitti_object", camera=False, progress=False)
    identity = before.identity
    monkeypatch.setattr("lidar_synth.lab.town.town.TABLES_HASH", "other clothes")
    assert before.identity != identity
    with pytest.raises(ConfigError, match=r"was filled with .*'tables'"):
        export_town(
            Town(5, "pandar64", 1), tmp_path, "kitti", camera=False, progress=False
        )


def test_scans_and_their_folder_name_their_skin_and_its_licence(tmp_path: Path) -> None:
    town = Town(5, "pandar64", 1, skin="pandar64")
    scan = town[0]
    assert "PandaSet" in scan.provenance["skin_licence"]
    assert scan.provenance["skin"] == load_skin("pandar64").digest
    export_town(town, tmp_path, "kitti_object", camera=False, progress=False)
    text = (tmp_path / "README.md").read_text()
    assert "PandaSet by Scale AI and Hesai" in text and "licence: CC BY 4.0" in text
    assert "layout: kitti_object;" in text
    # As earlier versions called it.
    assert '"layout": "kitti"' in (tmp_path / "town.json").read_text()
    assert export_town(town, tmp_path, "kitti", camera=False, progress=False) == (0, 1)


@pytest.mark.parametrize(
    ("layout", "jobs", "sequence", "message"),
    [
        (
            "kitti-360",
            1,
            None,
            "layout 'kitti-360'; expected .*Did you mean 'kitti360'",
        ),
        ("kitti360", 0, None, "^jobs 0"),
        ("kitti360", 1, 100, "sequence 100"),
    ],
)
def test_invalid_arguments_are_refused(
    tmp_path: Path,
    town: Town,
    layout: str,
    jobs: int,
    sequence: int | None,
    message: str,
) -> None:
    with pytest.raises(ConfigError, match=message):
        export_town(town, tmp_path / "out", layout, jobs=jobs, sequence=sequence)
    assert not (tmp_path / "out").exists()


def test_an_unwritable_folder_is_reported(tmp_path: Path, town: Town) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="cannot be written"):
        export_town(
            town, tmp_path / "file" / "out", "kitti360", camera=False, progress=False
        )


@pytest.mark.slow
def test_several_processes_write_the_same_files_as_one(
    tmp_path: Path, town: Town
) -> None:
    for jobs in (1, 2):
        export_town(
            town,
            tmp_path / str(jobs),
            "kitti360",
            camera=False,
            jobs=jobs,
            progress=False,
        )
    one, two = (
        {
            p.relative_to(tmp_path / j): p.read_bytes()
            for p in (tmp_path / j).rglob("*")
            if p.is_file()
        }
        for j in "12"
    )
    assert one == two


def test_work_is_grouped_by_stretch() -> None:
    assert _groups(list(range(3)), 1) == [[0], [1], [2]]
    assert _groups(list(range(45)), 2) == [
        list(range(20)),
        list(range(20, 40)),
        list(range(40, 45)),
    ]
    assert _groups([3, 4, 5, 6], 2) == [[3, 4], [5, 6]]
    assert _groups([19, 20], 1) == [[19], [20]]


@pytest.mark.slow
def test_the_command_writes_camera_images_and_accepts_sensors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command(tmp_path / "a", scans=1, seed=5, layout="kitti")
    assert "1 scans written, 0 were there already" in capsys.readouterr().out
    scan = KITTIObject(tmp_path / "a")[0]
    assert scan.image_path is not None
    from PIL import Image

    with Image.open(scan.image_path) as image:
        assert image.size == (1408, 376)
        assert np.array_equal(np.asarray(image), Town(seed=5, scans=1).image(0))
    command(
        tmp_path / "b",
        scans=1,
        sensor="hdl32e_nuscenes",
        camera=False,
        layout="semantic_kitti",
    )
    read = SemanticKITTI(tmp_path / "b", sensor="hdl32e_nuscenes")[0]
    assert len(read) > 5000 and read.sensor == load_sensor("hdl32e_nuscenes")
