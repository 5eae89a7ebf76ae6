"""Scan surgery, against worlds whose exact scan is known: without the object, and with it
elsewhere."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from box_scenes import CAR, HEIGHT, ROAD, WALL, car, cast, wall
from pasting import assert_nothing_shares_a_ray
from streets import kitti
from typer.testing import CliRunner

from lidar_synth import ObjectBank, Town, load_generator, load_sensor, open_scans
from lidar_synth.cli import app
from lidar_synth.datasets.classes import GROUND, IGNORE
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.formats import WRITERS
from lidar_synth.geometry.projection import locate, project, unproject
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.labels import edit, objects_of
from lidar_synth.labels.edit.insertion import cut_out
from lidar_synth.labels.edit.rays import rays_of_scan
from lidar_synth.labels.edit.removal import remove_returns, returns_of
from lidar_synth.labels.ground import FLOOR

BEHIND = wall(24, 0, np.pi / 2, length=80)


def returned(scan: Scan, hole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range and label in the cells of a hole."""
    image = project(scan)
    assert image.label is not None
    return image.range[hole], image.label[hole]


def cells_of(scan: Scan, points: np.ndarray) -> np.ndarray:
    hole = np.zeros(scan.sensor.shape, bool)
    hole.reshape(-1)[locate(scan.points[points], scan.sensor).cell] = True
    return hole


@pytest.mark.parametrize("labels", ["all", "object", "none"])
@pytest.mark.parametrize(
    "place", [(12, 2, 0.3), (9, -6, 1.4), (-14, 0.5, 0.1), (17, 5, 0.0)]
)
def test_behind_a_removed_car_is_what_was_there(
    place: tuple[float, float, float], labels: str
) -> None:
    full = cast([car(*place)], [BEHIND])
    empty = cast([], [BEHIND])
    labelled = labels == "all"
    bare = replace(
        full, label=None, instance=None, boxes=replace(full.boxes, instance=None)
    )
    own = np.where(full.label == CAR, full.label, IGNORE).astype(np.uint8)
    scan = {"all": full, "object": replace(bare, label=own), "none": bare}[labels]
    result = edit.remove(scan, 0)
    hole = cells_of(full, full.instance == 1)
    expected, label = returned(empty, hole)
    got = project(result).range[hole]
    assert ((got > 0) == (expected > 0)).mean() > 0.97
    assert np.median(np.abs(got - expected)[got > 0]) < (0.02 if labelled else 0.12)
    both = (got > 0) & (expected > 0)
    assert (np.abs(got - expected) < 0.4)[both].mean() > (0.9 if labelled else 0.69)
    if labelled:
        assert (returned(result, hole)[1] == label).mean() > 0.93 and not (
            result.label == CAR
        ).any()
    kept = project(full).range[~hole]
    assert np.allclose(project(result).range[~hole], kept, atol=1e-4)
    assert result.boxes is not None and not len(result.boxes)


def test_other_objects_do_not_grow_into_the_hole() -> None:
    cars = [car(10, 0), car(10, 2.4), car(10, -2.4)]
    full = cast(cars, [BEHIND])
    result = edit.remove(full, 0)
    assert result.boxes is not None and np.array_equal(result.boxes.instance, [2, 3])
    for number in (2, 3):
        assert (result.instance == number).sum() == (full.instance == number).sum()
    assert set(np.unique(result.label[~np.isin(result.instance, [2, 3])])) == {WALL, 8}


def test_what_stands_in_front_stays_and_does_not_continue_behind() -> None:
    pole = wall(7, 0, 0.0, length=0.3)
    full = cast([car(12, 0, 1.5)], [BEHIND, pole])
    empty = cast([], [BEHIND, pole])
    result = edit.remove(full, 0)
    got = project(result).range
    expected = project(empty).range
    assert (np.abs(got - expected) < 0.3).mean() > 0.995


def test_rays_that_the_object_absorbed_belong_to_the_hole() -> None:
    full = cast([car(12, 0)], [BEHIND])
    mine = np.flatnonzero(full.instance == 1)
    windows = replace(full[np.delete(np.arange(len(full)), mine[::3])])
    hole = cells_of(full, mine)
    assert (project(edit.remove(windows, 0)).range[hole] > 0).mean() > 0.97


def test_the_rays_of_a_scan_lead_to_its_points() -> None:
    for scan in (cast([car(12, 0)]), Town(seed=3, scans=1)[0]):
        rays = rays_of_scan(scan)
        there = np.flatnonzero(rays.point >= 0)
        assert np.array_equal(np.sort(rays.point[there]), np.arange(len(scan)))
        assert np.allclose(
            rays.points(there, rays.rho[there]),
            scan.points[rays.point[there]],
            atol=1e-5,
        )


def test_a_range_image_has_one_ray_per_column() -> None:
    """With the rings of its returns too, where its sensor fires more often."""
    image = project(Town(seed=3, scans=1)[0])
    scan = unproject(image)
    assert scan.ring is not None
    for ring in (scan.ring, None):
        count = len(rays_of_scan(replace(scan, ring=ring)).point)
        assert abs(count / image.range.size - 1) < 0.02


def test_rays_of_a_grid_start_where_its_rows_do() -> None:
    sensor = load_sensor("hdl64e_lasers")
    scan = unproject(project(Town(seed=0, scans=1, sensor=sensor, motion=False)[0]))
    rays = rays_of_scan(replace(scan, ring=None))
    assert np.array_equal(rays.height.astype(np.float32), sensor.starts[rays.ring])
    assert np.allclose(
        rays.slope, np.tan(sensor.row_elevations())[rays.ring], atol=1e-4
    )


@pytest.mark.parametrize(
    "old, new",
    [
        ((10, 0, 0.3), (14, 6, None)),
        ((12, -4, 1.2), (8, 3, None)),
        ((-9, 2, 0.0), (11, -3, 3.0)),
        ((10, 5, 0.2), (11, -6.2, -0.1)),
    ],
)
def test_a_moved_car_looks_as_the_sensor_would_see_it(old: Any, new: Any) -> None:
    before = cast([car(*old)], [BEHIND])
    pose = [v for v in new if v is not None]
    result = edit.move(before, 0, pose)
    assert (
        result.boxes is not None
        and len(result.boxes) == 1
        and result.boxes.names == ("Car",)
    )
    box = result.boxes.values[0]
    assert np.allclose(box[:2], new[:2], atol=1e-3)
    truth = cast([np.r_[box[:2], car(0, 0)[2:6], box[6]].astype(np.float32)], [BEHIND])
    mine = cells_of(result, result.label == CAR)
    true = cells_of(truth, truth.instance == 1)
    assert (mine & true).sum() / (mine | true).sum() > 0.7
    assert 0.85 < mine.sum() / true.sum() < 1.15
    both = mine & true
    assert np.median(np.abs(project(result).range - project(truth).range)[both]) < 0.05
    assert result.boxes.contain(result.points[result.label == CAR]).all()
    number = result.boxes.instance[0]
    assert (result.instance == number).sum() == (result.label == CAR).sum() > 50


def test_an_inserted_car_hides_and_is_hidden() -> None:
    pole = wall(6, 0.2, 0.0, length=0.4)
    [item] = [cut_out(cast([car(12, 0, 1.57)]), 0)]
    result = edit.insert(cast([], [pole, BEHIND]), item)
    assert result.boxes is not None
    front = cells_of(cast([], [pole]), cast([], [pole]).label == WALL)
    assert (project(result).label[front] == WALL).all()
    alone = edit.insert(cast([], [BEHIND]), item)
    assert 20 < (result.label == CAR).sum() < (alone.label == CAR).sum()
    assert_nothing_shares_a_ray(alone, 1)


def test_a_car_beside_a_wall_returns_to_its_place() -> None:
    """Where it stood it can stand, whatever is near; but not twice."""
    full = cast([car(12, 0)], [wall(12, 1.1, length=6)])
    item = cut_out(full, 0)
    back = edit.insert(edit.remove(full, 0), item)
    assert (
        back.boxes is not None
        and np.abs(back.boxes.values[0] - full.boxes.values[0]).max() < 0.12
    )
    assert (
        cells_of(back, back.label == CAR).sum()
        > 0.9 * cells_of(full, full.label == CAR).sum()
    )
    with pytest.raises(DataError, match="other returns|no level ground"):
        edit.insert(replace(full, boxes=None), item)


def test_what_is_estimated_behind_a_car_does_not_stand_in_its_way() -> None:
    full = cast([car(12, 0)], [wall(12.5, 2.6, np.pi / 2, length=2), BEHIND])
    result = edit.move(full, 0, (12.6, 0))
    assert result.boxes is not None and np.allclose(
        result.boxes.values[0, :2], (12.6, 0), atol=1e-3
    )
    inside = result.boxes.contain(result.points, above_floor=FLOOR)[0]
    assert (result.label[inside] == CAR).all() and inside.sum() > 100


def test_no_sheet_stands_where_an_object_was() -> None:
    """Beside the car begins a wall that is nearer than the far end of the car, and behind it is
    another."""
    walls = [wall(12.5, -5, np.pi / 2, length=6), BEHIND]
    full = cast([car(12, 0)], walls)
    empty = cast([], walls)
    got, expected = (project(scan).range for scan in (edit.remove(full, 0), empty))
    both = (got > 0) & (expected > 0)
    assert (np.abs(got - expected)[both] > 0.4).sum() < 10


def test_ground_beside_a_wall_stays_level() -> None:
    full = cast([car(6.84, -0.71, 2.78)], [wall(8.2, 2.4, 2.34, length=3.94), BEHIND])
    result = edit.remove(full, 0)
    height = result.points[:, 2] + HEIGHT
    assert (np.abs(height[result.label == ROAD]) > 0.2).sum() < 50


def test_single_returns_do_not_keep_an_object_from_its_place() -> None:
    item = cut_out(cast([car(12, 0)]), 0)
    for count in (2, 3):
        scan = cast([], [BEHIND])
        far = np.flatnonzero(scan.label == WALL)[:count]
        scan.points[far] = (12, 6, -1)
        if count == 2:
            assert len(edit.insert(scan, item, (12, 6)).boxes) == 1
        else:
            with pytest.raises(DataError, match="3 other returns"):
                edit.insert(scan, item, (12, 6))


def test_where_an_object_stands_is_ground() -> None:
    """Behind the car, no ground was recorded."""
    full = cast([car(12, 0)], [BEHIND])
    full = full[(full.label != ROAD) | (full.points[:, 0] < 11)]
    moved = edit.move(full, 0, (12.4, 0))
    assert np.allclose(moved.boxes.values[0, :2], (12.4, 0), atol=1e-3)
    with pytest.raises(DataError, match="no level ground"):
        edit.move(full, 0, (16, 0))


def test_a_box_in_the_way_is_named_by_its_number_in_the_scan() -> None:
    scan = cast([car(12, 0), car(10, 6), car(10, -6)], [BEHIND])
    with pytest.raises(DataError, match=r"overlaps box 2 \(Car\)"):
        edit.move(scan, 0, (10, -6.5))


@pytest.mark.slow
def test_removed_objects_return_to_their_places() -> None:
    """In streets with fences, hedges and poles beside the cars; their own returns stand in the way
    until removed."""
    tried = returned_to = 0
    for seed in (1, 2, 6, 11):
        town = Town(seed=seed, scans=1)[0]
        for number, item in objects_of(town, 200).items():
            if item.scan.boxes.names[0] not in ("Car", "Van"):
                continue
            others = np.arange(len(town.boxes)) != number
            with pytest.raises(DataError, match="other returns|no level ground"):
                edit.insert(replace(town, boxes=town.boxes[others]), item)
            emptied = edit.remove(town, number)
            tried = tried + 1
            estimated = ~np.isin(
                emptied.points.view("V12").ravel(), town.points.view("V12").ravel()
            )
            inside = item.scan.boxes.contain(emptied.points)[0]
            assert GROUND[
                emptied.label[
                    estimated & inside & (emptied.points[:, 2] > item.ground + FLOOR)
                ]
            ].all()
            try:
                back = edit.insert(emptied, item)
            except DataError:
                continue
            returned_to += 1
            assert np.abs(back.boxes.values[-1, :3] - item.box[:3]).max() < 0.1
            before = cells_of(town, town.instance == town.boxes.instance[number])
            after = cells_of(back, back.instance == back.boxes.instance[-1])
            assert (before & after).sum() > 0.6 * (before | after).sum()
    assert tried >= 8 and returned_to >= 0.8 * tried


def test_objects_of_a_bank_are_inserted() -> None:
    bank = ObjectBank.from_scans([cast([car(12, 0, 0.4)])])
    result = edit.insert(cast([], [BEHIND]), bank[0], (13, 4))
    assert result.boxes is not None
    assert (
        result.boxes.contain(result.points[result.label == CAR]).all()
        and (result.label == CAR).sum() > 100
    )


def test_boxes_given_by_their_values_leave_the_scan() -> None:
    scan = cast([car(12, 0), car(10, 6), car(10, -6)], [BEHIND])
    for box in (
        1,
        [1],
        scan.boxes[[1]],
        scan.boxes.values[1],
        scan.boxes.values[[1, 1]],
    ):
        left = edit.remove(scan, box).boxes
        assert left is not None and np.array_equal(
            left.values, scan.boxes.values[[0, 2]]
        )
    beside = edit.remove(
        scan, scan.boxes.values[1] + np.float32([0.1, 0, 0, 0, 0, 0, 0])
    )
    assert len(beside.boxes) == 3, "a box of one's own is none of the scan's"


@pytest.mark.parametrize(
    "none", [[], np.zeros((0, 7), np.float32), Boxes(np.zeros((0, 7), np.float32), ())]
)
def test_without_boxes_to_remove_the_scan_stays(none: Any) -> None:
    assert edit.remove(SCAN, none) is SCAN


SCAN = cast([car(12, 0, 0.3), car(8, 8)], [BEHIND])
ITEM = cut_out(SCAN, 0)
BAD: dict[str, tuple[Callable[[], Any], type[Exception], str]] = {
    "number": (
        lambda: edit.remove(SCAN, 2),
        DataError,
        r"box 2 of scan 'world' with 2 boxes; expected numbers",
    ),
    "no boxes": (
        lambda: edit.remove(replace(SCAN, boxes=None), 0),
        DataError,
        "with 0 boxes.*takes a box",
    ),
    "shape": (
        lambda: edit.remove(SCAN, [1.0, 2.0]),
        DataError,
        r"a box of shape \(2,\)",
    ),
    "whole numbers": (
        lambda: edit.remove(SCAN, [1, 1, 0, 0, 1, 1, 0]),
        DataError,
        "each number once, or a box .* as floats",
    ),
    "far": (
        lambda: edit.remove(SCAN, car(90, 0)),
        DataError,
        "90.0 m away; expected at most 80 m",
    ),
    "empty": (
        lambda: edit.remove(SCAN, car(-9, 0) + np.float32([0, 0, 6, 0, 0, 0, 0])),
        DataError,
        "without a return",
    ),
    "model": (
        lambda: edit.remove(SCAN, 0, model="nothing"),
        ConfigError,
        "model 'nothing'; expected a shipped one",
    ),
    "conditional": (
        lambda: edit.remove(SCAN, 0, model="town-camera"),
        ConfigError,
        "expected an unconditional",
    ),
    "sensor": (
        lambda: edit.remove(
            cast([car(12, 0)], sensor=load_sensor("os1_128")), 0, model="town"
        ),
        DataError,
        "a scan of sensor 'os1_128' .* for a model of 'hdl64e_lasers'.*model=None",
    ),
    "overlap": (
        lambda: edit.insert(SCAN, ITEM, (8, 7)),
        DataError,
        r"overlaps box 1 \(Car\); expected a free place",
    ),
    "wall": (
        lambda: edit.insert(SCAN, ITEM, (24, 0)),
        DataError,
        "no level ground|other returns",
    ),
    "behind": (lambda: edit.insert(SCAN, ITEM, (30, 0)), DataError, "no level ground"),
    "out of range": (
        lambda: edit.insert(SCAN, ITEM, (95, 0)),
        DataError,
        "95.0 m away; expected a place 1.45 to 80 m",
    ),
    "too near": (lambda: edit.insert(SCAN, ITEM, (4, -3)), DataError, "at least 6.0 m"),
    "other side": (
        lambda: edit.insert(SCAN, ITEM, (-12, 3, 1.7)),
        DataError,
        "beside the side that was recorded",
    ),
    "pose": (
        lambda: edit.insert(SCAN, ITEM, (1.0,)),
        DataError,
        "expected x, y in metres",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused(name: str) -> None:
    run, kind, message = BAD[name]
    with pytest.raises(kind, match=message):
        run()


def test_files_keep_their_fields() -> None:
    """A file in ring order stays in ring order, and its classes as in the file stay."""
    town = Town(seed=4, scans=1)[0]
    number = max(
        (i for i, n in enumerate(town.boxes.names) if n == "Car"),
        key=lambda i: returns_of(town, town.boxes[[i]]).sum(),
    )
    result = edit.remove(town, number)
    assert sorted(result.fields()) == sorted(town.fields())
    assert (np.diff(result.ring.astype(int)) >= 0).all() == (
        np.diff(town.ring.astype(int)) >= 0
    ).all()
    removed = returns_of(town, town.boxes[[number]])
    rows = {tuple(row) for row in result.points[:: max(len(result) // 500, 1)].tolist()}
    assert len(rows & {tuple(row) for row in town.points[~removed].tolist()}) > 400
    assert result.raw_label is not None and set(np.unique(result.raw_label)) <= set(
        np.unique(town.raw_label)
    ) | {0}


@pytest.mark.slow
def test_the_flow_draws_the_hole_and_nothing_else() -> None:
    generator = load_generator("town")
    [scan] = generator.scans(seed=5, indices=[1])
    scan = replace(scan, boxes=Boxes(np.zeros((0, 7), np.float32), ()))
    assert edit.measure([scan]).objects > 0
    by_geometry = edit.remove_unboxed(scan)
    drawn = edit.remove_unboxed(scan, generator)
    again = edit.remove_unboxed(scan, generator)
    assert np.array_equal(drawn.points, again.points)
    before, filled, new = (
        {tuple(p) for p in s.points.tolist()} for s in (scan, by_geometry, drawn)
    )
    assert before & filled == before & new and len(before & new) > 0.8 * len(before)
    assert len(new - before) > 0.5 * len(filled - before) and not filled - before <= new
    for result in (by_geometry, drawn):
        assert edit.measure([result]).objects == 0


def test_a_drawn_road_is_level_where_rays_start_above_the_origin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A model that draws exactly what was there gives back the scan."""
    sensor = load_sensor("hdl64e_lasers")
    image = project(Town(seed=0, scans=1, sensor=sensor, motion=False)[0])
    scan = unproject(image)
    monkeypatch.setattr("lidar_synth.generate.inpaint.inpaint", lambda *_: [image])
    x, y, _ = scan.points.T
    removed = GROUND[scan.label] & (x > 6) & (x < 20) & (np.abs(y) < 0.15 * x)
    box = np.array([13, 0, -1, 10, 3, 2, 0], np.float32)
    result = remove_returns(
        scan,
        [(removed, box)],
        SimpleNamespace(condition=None, header=SimpleNamespace(sensor=sensor)),
        0,
    )
    assert removed.sum() > 500 and np.allclose(result.points, scan.points, atol=1e-3)


def test_the_command_line_keeps_the_calibration(tmp_path: Path) -> None:
    """KITTI's ``testing`` has no boxes; its scans are passed on."""
    root = kitti(tmp_path / "kitti", 2)
    for folder in ("velodyne", "calib", "image_2"):
        (root / "testing" / folder).mkdir(parents=True)
        for path in (root / "training" / folder).glob("000000.*"):
            shutil.copy(path, root / "testing" / folder)
    command = [
        "edit",
        "remove",
        str(root),
        str(tmp_path / "out"),
        "--name",
        "Car",
        "--to",
        "kitti_object",
    ]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output + str(result.exception)
    given = open_scans(root)
    edited = open_scans(tmp_path / "out")
    assert given.ids == edited.ids
    for index in range(len(given)):
        a = given.calibration(index)
        b = edited.calibration(index)
        assert np.allclose(a.projection, b.projection) and np.allclose(
            a.camera_from_sensor, b.camera_from_sensor
        )


def test_a_moved_object_keeps_its_box_without_pictures(tmp_path: Path) -> None:
    """The folder ``image_2``, from which the size of the image is known, need not be there."""
    root = kitti(tmp_path / "kitti", 1)
    shutil.rmtree(root / "training" / "image_2")
    [scan] = open_scans(root)
    box = int(
        np.argmax(
            [returns_of(scan, scan.boxes[[i]]).sum() for i in range(len(scan.boxes))]
        )
    )
    command = [
        "edit",
        "move",
        str(root),
        str(tmp_path / "out"),
        "--box",
        str(box),
        "--at",
        "20,0",
    ]
    result = CliRunner().invoke(app, [*command, "--to", "kitti_object"])
    assert result.exit_code == 0, result.output + str(result.exception)
    values = open_scans(tmp_path / "out")[0].boxes.values
    assert np.abs(values[:, :2] - [20, 0]).sum(1).min() < 0.1


def test_the_command_line_edits_scans(tmp_path: Path) -> None:
    writer = WRITERS["npz"](tmp_path / "in")
    writer.write(SCAN, 0)
    writer.finish()
    ObjectBank.from_scans([cast([car(12, 0, 0.4)])]).save(tmp_path / "objects.npz")
    calls = {
        "named": ["remove", "--name", "Car"],
        "numbered": ["remove", "--box", "1"],
        "moved": ["move", "--box", "0", "--at", "14,-6"],
        "inserted": [
            "insert",
            "--objects",
            str(tmp_path / "objects.npz"),
            "--at",
            "10,-9",
        ],
    }
    counts = {}
    for name, (command, *options) in calls.items():
        result = CliRunner().invoke(
            app, ["edit", command, str(tmp_path / "in"), str(tmp_path / name), *options]
        )
        assert result.exit_code == 0, result.output + str(result.exception)
        scan = open_scans(tmp_path / name)[0]
        counts[name] = len(scan.boxes)
    assert counts == {"named": 0, "numbered": 1, "moved": 2, "inserted": 3}
    for options, message in {
        ("--name", "Dragon"): "expected the class of some box",
        (): "expected one of the two",
    }.items():
        result = CliRunner().invoke(
            app,
            ["edit", "remove", str(tmp_path / "in"), str(tmp_path / "out"), *options],
        )
        assert isinstance(result.exception, ConfigError) and message in str(
            result.exception
        )


def test_what_a_killed_edit_left_is_removed(tmp_path: Path) -> None:
    writer = WRITERS["npz"](tmp_path / "in")
    writer.write(SCAN, 0)
    writer.finish()
    part = tmp_path / "out" / ".000000.npz.12345678.part"
    part.parent.mkdir()
    part.write_bytes(b"of a killed run")
    words = [
        "edit",
        "remove",
        str(tmp_path / "in"),
        str(tmp_path / "out"),
        "--box",
        "1",
    ]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert not part.exists()
