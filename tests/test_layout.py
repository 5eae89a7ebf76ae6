"""Layouts: their image on a sensor's rays against slow independent casting, their files, and their
errors."""

import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lidar_synth import Layout, Town, layout_of, load_layout, load_sensor
from lidar_synth.datasets.classes import BOXED, IGNORE, LABELS
from lidar_synth.errors import ConfigError, DataError
from lidar_synth.geometry.layout import CODES, Outline, layout_image, select_known_boxes
from lidar_synth.geometry.layout.raster import depth_of
from lidar_synth.geometry.overlap import overlapping_pairs
from lidar_synth.geometry.scan import Boxes
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.evaluate.layouts import layout_agreement, rays_of_boxes
from lidar_synth.labels.boxes import turn_boxes, widen_boxes

SMALL = Sensor("small", 64, 1.45, 80.0, rows=16, fov_up=3.0, fov_down=-25.0)
LASERS = Sensor(
    "lasers",
    64,
    1.45,
    80.0,
    elevations=tuple(np.linspace(2, -24, 16)),
    heights=(0.2,) * 16,
)
NAMES = (
    "Car",
    "Van",
    "Truck",
    "Pedestrian",
    "Person_sitting",
    "Cyclist",
    "Tram",
    "Misc",
    "Motorcyclist",
)


def some_layout(seed: int, count: int = 12, walls: bool = True) -> Layout:
    """Boxes that stand apart on sloping ground, and walls around them."""
    rng = np.random.default_rng(seed)
    rows = np.zeros((0, 7), np.float32)
    while len(rows) < count:
        azimuth = rng.uniform(-np.pi, np.pi)
        distance = rng.uniform(4, 30)
        size = rng.uniform((0.5, 0.5, 1.0), (8, 2.5, 3))
        height = -1.7 + size[2] / 2 + rng.uniform(-0.1, 0.3)
        place = (distance * np.cos(azimuth), distance * np.sin(azimuth), height)
        more = np.concatenate(
            [rows, [(*place, *size, rng.uniform(-np.pi, np.pi))]]
        ).astype(np.float32)
        boxes = Boxes(more, ("Car",) * len(more))
        if (
            not overlapping_pairs(boxes, 0.0)
            and not Boxes(widen_boxes(more, 1.0), boxes.names)
            .contain(np.zeros((1, 3), "f4"))
            .any()
        ):
            rows = more
    outlines = [
        Outline(
            "building",
            np.float32([(-40, 18), (5, 20), (40, 15)]),
            -1.9,
            np.float32([6, 4, 9]),
        ),
        Outline("vegetation", np.float32([(10, -12), (14, -9), (20, -12)]), 0.3, 4.0),
        Outline("fence", np.float32([(-15, -20), (-15, 5)]), -2.0, -0.7),
        Outline(
            "fence", np.float32([(-30, 10), (30, 11)]), -2.0, -1.2
        ),  # lower than the building behind it
    ]
    names = tuple(rng.choice(NAMES, count).tolist())
    return Layout(
        Boxes(rows, names), (-1.7, 0.01, -0.02), outlines if walls else (), reach=60.0
    )


def marched(
    layout: Layout, sensor: Sensor, step: float = 0.02
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Class and distance by walking along each ray: slow, and without the mathematics of the
    raster."""
    rows, columns = sensor.shape
    code = np.zeros(sensor.shape, np.uint8)
    depth = np.zeros(sensor.shape, np.float32)
    at = np.arange(step, sensor.range_max, step)
    plane = np.array([*layout.ground[1:], -1])
    for i in range(rows):
        lift = sensor.starts[i] if len(sensor.starts) else 0.0
        for j in range(columns):
            direction = sensor.ray_directions()[i, j].astype(np.float64)
            points = at[:, None] * direction + (0, 0, lift)
            hit = []
            inside = layout.boxes.contain(points.astype(np.float32))
            for k in np.flatnonzero(inside.any(1)):
                hit.append((at[inside[k].argmax()], layout.codes()[k]))
            for wall in layout.outlines:
                hit += [(x, CODES[wall.kind]) for x in crossings(points, at, wall)]
            buried = (points @ plane + layout.ground[0] > 0) & (
                np.hypot(*points[:, :2].T) <= layout.reach
            )
            if buried.any() and not inside.any():
                hit.append((at[buried.argmax()], CODES["ground"]))
            if hit and (nearest := min(hit))[0] >= sensor.range_min:
                depth[i, j], code[i, j] = nearest
    return code, depth


def crossings(points: NDArray[Any], at: NDArray[Any], wall: Outline) -> list[float]:
    """Distances at which a walk crosses a wall."""
    found = []
    edges = zip(np.asarray(wall.low), np.asarray(wall.high), strict=True)
    corners = [(*corner, *edge) for corner, edge in zip(wall.line, edges, strict=True)]
    for (x1, y1, low1, high1), (x2, y2, low2, high2) in pairwise(corners):
        along = np.array([x2 - x1, y2 - y1])
        normal = np.array([y1 - y2, x2 - x1])
        side = (points[:, :2] - (x1, y1)) @ normal > 0
        for k in np.flatnonzero(side[1:] != side[:-1]):
            share = (points[k, :2] - (x1, y1)) @ along / (along @ along)
            low = low1 + share * (low2 - low1)
            high = high1 + share * (high2 - high1)
            if 0 <= share <= 1 and low <= points[k, 2] <= high:
                found.append(float(at[k]))
    return found


@pytest.mark.parametrize("sensor", [SMALL, LASERS], ids=lambda s: s.name)
@pytest.mark.parametrize("seed", range(3))
def test_the_image_is_that_of_walking_along_the_rays(seed: int, sensor: Sensor) -> None:
    layout = some_layout(seed)
    image = layout_image(layout, sensor)
    code, depth = marched(layout, sensor)
    same = image[0] == code  # a ray that grazes an edge may differ
    assert same.mean() > 0.985
    assert len(np.unique(code)) > 6
    steps = np.abs(depth_of(image) - depth)[same]
    # The walk stops after the surface, and grazes the ground later.
    assert np.quantile(steps, 0.99) < 0.06


def test_the_ground_hides_no_box() -> None:
    layout = some_layout(1, walls=False)
    sensor = load_sensor("hdl64e_lasers")
    boxed = [
        layout_image(replace(layout, ground=(z, 0.0, 0.0)), sensor)[0]
        for z in (-2.5, -1.2)
    ]
    assert (boxed[0] >= CODES["Car"]).sum() > 5000
    assert np.array_equal(boxed[0] >= CODES["Car"], boxed[1] >= CODES["Car"])


@pytest.mark.parametrize("seed", range(4))
def test_the_cells_of_a_box_look_at_points_of_its_surface(seed: int) -> None:
    layout = some_layout(seed)
    sensor = load_sensor("hdl64e_lasers")
    image = layout_image(layout, sensor)
    depth = depth_of(image).astype(np.float64)
    points = depth[..., None] * sensor.ray_directions()
    points[..., 2] += sensor.starts[:, None]
    seen = image[0] >= CODES["Car"]
    assert seen.sum() > 5000
    larger = replace(
        layout.boxes,
        values=layout.boxes.values + np.float32([0, 0, 0, 0.01, 0.01, 0.01, 0]),
    )
    smaller = replace(
        layout.boxes,
        values=layout.boxes.values - np.float32([0, 0, 0, 0.01, 0.01, 0.01, 0]),
    )
    around, within = (
        b.contain(points[seen].astype(np.float32)) for b in (larger, smaller)
    )
    assert around.any(0).all() and not within.any()
    # The class is that of the box, and the way along the ray ends inside it.
    first = around.argmax(0)
    single = around.sum(0) == 1
    assert (layout.codes()[first] == image[0][seen])[single].all()
    deeper = points[seen] + sensor.ray_directions()[seen] * (
        image[3][seen, None] * 0.1 / 2
    )
    assert (
        larger.contain(deeper.astype(np.float32))[first, np.arange(len(first))]
        | (image[3][seen] == 0)
    ).mean() > 0.999
    x, y, _, length, *_, yaw = layout.boxes.values[first].T
    along = (
        (points[seen][:, 0] - x) * np.cos(yaw) + (points[seen][:, 1] - y) * np.sin(yaw)
    ) / length + 0.5
    assert np.abs(image[4][seen] / 255 - along)[single].max() < 0.02


def test_nothing_is_known_beyond_the_depths_of_an_image() -> None:
    """Two bytes end at 131 m; the front of the farther truck would be there instead of at 154 m."""
    trucks = Boxes(
        np.array([(160, 0, 0, 12, 6, 6, 0), (0, 126, 0, 12, 6, 6, 0)], np.float32),
        ("Truck", "Truck"),
    )
    sensor = load_sensor("vls128")
    image = layout_image(Layout(trucks), sensor)
    seen = image[0] == CODES["Truck"]
    assert (
        sensor.range_max > 160
        and seen.any()
        and 122 < depth_of(image)[seen].max() < 131.07
    )
    assert not seen[:, sensor.columns // 2 - 50 : sensor.columns // 2 + 50].any()


def test_turning_rolls_and_mirroring_flips() -> None:
    sensor = load_sensor("hdl64e_lasers")
    layout = replace(some_layout(5, walls=False), ground=(-1.7, 0.0, 0.0))
    image = layout_image(layout, sensor)
    columns = 300
    rolled = layout_image(
        replace(layout, boxes=turn_boxes(layout.boxes, 2 * np.pi * columns / 2048)),
        sensor,
    )
    assert (np.roll(rolled, columns, -1) == image).all(
        0
    ).mean() > 0.99  # turned to the left, back to the right
    mirrored = layout.boxes.values * np.float32([1, -1, 1, 1, 1, 1, -1])
    flipped = layout_image(
        replace(layout, boxes=replace(layout.boxes, values=mirrored)), sensor
    )
    assert (flipped[..., ::-1] == image).all(0).mean() > 0.999


@pytest.fixture(scope="module")
def town() -> Any:
    return Town(seed=3, sensor="hdl64e_lasers", scans=2, motion=False)[0]


def test_the_layout_of_a_scan_shows_what_the_scan_does(town: Any) -> None:
    from lidar_synth.datasets.classes import TRAIN_ID
    from lidar_synth.geometry.projection import project

    layout = layout_of(town)
    seen = project(town, town.sensor, ["label"])
    image = layout_image(layout, town.sensor)
    assert (
        set(layout.boxes.names) == set(town.boxes.names)
        and abs(layout.ground[0] + 1.73) < 0.3
    )
    for name, classes, least in (
        ("ground", ("road", "sidewalk", "terrain", "parking", "other-ground"), 0.85),
        ("building", ("building",), 0.4),
        ("vegetation", ("vegetation", "trunk"), 0.5),
    ):
        cells = np.isin(seen.label, [TRAIN_ID[c] for c in classes]) & (
            image[0] == CODES[name]
        )
        there = np.isin(seen.label, [TRAIN_ID[c] for c in classes])
        assert cells.sum() > least * there.sum(), name
        assert np.median(np.abs(depth_of(image) - seen.range)[cells]) < 0.6, name
    boxed = np.isin(
        seen.label, [TRAIN_ID["car"], TRAIN_ID["truck"], TRAIN_ID["person"]]
    )
    assert (image[0][boxed] >= CODES["Car"]).mean() > 0.9


def test_the_layout_of_a_scan_has_the_boxes_within_the_range(town: Any) -> None:
    inside = town.boxes[np.hypot(*town.boxes.values[:, :2].T) <= 80]
    assert layout_of(town).boxes.names == inside.names
    values = inside.values.copy()
    values[0, :2] = 80.5, 0  # its nearer half is within 80 m
    assert (
        layout_of(replace(town, boxes=replace(inside, values=values))).boxes.names
        == inside.names[1:]
    )


def test_only_boxes_that_overlap_a_kept_one_are_dropped(town: Any) -> None:
    """The second of three in a row overlaps both others, which stand apart."""
    row = Boxes(
        np.array([(x, 0, -1, 4, 2, 1.5, 0) for x in (10, 13, 16)], np.float32),
        ("Car",) * 3,
    )
    assert select_known_boxes(replace(town, boxes=row)).values[:, 0].tolist() == [
        10,
        16,
    ]


def test_a_scan_without_labels_has_ground_and_outlines(town: Any) -> None:
    bare = replace(town, label=None, raw_label=None)
    layout = layout_of(bare)
    known = layout_of(town)
    assert abs(layout.ground[0] - known.ground[0]) < 0.15
    assert {outline.kind for outline in layout.outlines} <= {
        "building",
        "vegetation",
    } and len(layout.outlines) > 20
    objects = np.where(np.isin(town.label, BOXED), town.label, IGNORE).astype(np.uint8)
    assert layout_of(replace(bare, label=objects)).ground == layout.ground
    with pytest.raises(DataError, match="has no boxes"):
        layout_of(replace(town, boxes=None))
    with pytest.raises(DataError, match="returns of the ground"):
        layout_of(town[town.points[:, 2] > 0])


def test_a_scan_agrees_with_its_own_layout_and_not_with_another(town: Any) -> None:
    layout = layout_of(town)
    found = layout_agreement([town], [layout], [town])
    assert found.inside_share > 0.99 and found.kept_share == 1 and found.points > 100
    assert 0.5 < found.filled_share <= 1 and 0 < found.seen <= found.boxes <= len(
        layout.boxes
    )
    turned_away = replace(layout, boxes=turn_boxes(layout.boxes, np.pi / 2))
    other = layout_agreement([town], [turned_away], [town])
    assert other.inside_share < 0.5 and other.points == found.points
    with pytest.raises(DataError, match="has no labels"):
        layout_agreement([replace(town, label=None)], [layout], [town])
    image = layout_image(layout, town.sensor)
    assert (
        abs(
            rays_of_boxes(layout, town.sensor).sum() / (image[0] >= CODES["Car"]).sum()
            - 1
        )
        < 0.05
    )


GOOD = """
ground: -1.7
reach: 20
objects:
  - {class: Van, at: [12, 0]}
  - {class: Cyclist, at: [16.5, 0.4], heading: 180, size: [1.8, 0.6, 1.7]}
  - {class: Bus, at: [-20, 8], above: 0.1}
outlines:
  - {kind: building, line: [[-10, 19], [40, 19]], height: 8}
  - {kind: vegetation, line: [[5, -7], [12, -7]], from: 2, height: 6}
"""


def test_a_file_is_the_layout_that_it_describes(tmp_path: Path) -> None:
    path = tmp_path / "behind.yaml"
    path.write_text(GOOD)
    layout = load_layout(path)
    assert layout.boxes.names == ("Van", "Cyclist", "Misc") and layout.id == "behind"
    assert np.allclose(
        layout.boxes.values[1],
        (16.5, 0.4, -1.7 + 0.85, 1.8, 0.6, 1.7, -np.pi),
        atol=1e-4,
    )
    assert np.allclose(
        layout.boxes.values[2],
        (-20, 8, -1.6 + 3.05 / 2, 11.8, 2.55, 3.05, 0),
        atol=1e-4,
    )
    assert layout.outlines[1].low[0] == np.float32(0.3)  # type: ignore[index]
    assert layout.reach == 20
    image = layout_image(layout, load_sensor("hdl64e_lasers"))
    assert {
        0,
        *(CODES[n] for n in ("ground", "building", "vegetation", "Van", "Misc")),
    } == set(np.unique(image[0]))


BAD = {
    "objects: [{class: Dragon, at: [9, 0]}]": (
        ConfigError,
        "class 'Dragon'; expected one of 'Car', 'Van'",
    ),
    "objects: [{class: Car}]": (
        ConfigError,
        r"objects\.0\.at: Field required; expected class and at, and maybe heading",
    ),
    "objects: [Car]": (ConfigError, r"objects\.0: .* valid dictionary; expected class"),
    "objects: [{class: Car, at: [9, .nan]}]": (ConfigError, r"objects\.0\.at\.1"),
    "objects: [{class: Car, at: [9, 0], colour: red}]": (
        ConfigError,
        r"objects\.0\.colour: Extra inputs",
    ),
    "objects: [{class: Car, at: [9, 0], size: [4, 0, 1]}]": (
        ConfigError,
        r"objects\.0\.size\.1",
    ),
    "outlines: [{kind: sea, line: [[1, 2], [2, 3]], height: 3}]": (
        ConfigError,
        r"outlines\.0\.kind: .*; expected kind, line and height",
    ),
    "outlines: [{kind: fence, line: [[1, 2]], height: 3}]": (ConfigError, "at least 2"),
    "outlines: [{kind: fence, line: [[1, 2], [2, 3]], from: 4, height: 3}]": (
        DataError,
        "low < high",
    ),
    "objects: [{class: Car, at: [9, 0]}, {class: Van, at: [10, 0.5]}]": (
        DataError,
        r"boxes 0 and 1 \(Car and Van\)",
    ),
    "objects: [{class: Car, at: [0.5, 0]}]": (DataError, "around the sensor"),
    "ground: 1": (DataError, r"ground .*expected -10 to -0\.2 m"),
    "outlines: [{kind: fence, line: [[1, 2], [1, 2]], height: 3}]": (
        DataError,
        "corners x, y in metres, apart",
    ),
    "": (ConfigError, "its top level: .* valid dictionary; expected ground, reach"),
    "[1, 2]": (ConfigError, "its top level"),
    "a: !!python/object:os.system {}": (ConfigError, "is not YAML of plain values"),
}


@pytest.mark.parametrize("text", BAD)
def test_an_invalid_file_is_refused(text: str, tmp_path: Path) -> None:
    kind, message = BAD[text]
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(kind, match=message):
        load_layout(path)


def test_an_unknown_class_is_refused() -> None:
    with pytest.raises(
        DataError, match="boxes of 'Bicycle'; expected classes of Car, Van"
    ):
        Layout(Boxes(np.float32([[9, 0, -1, 1, 1, 1, 0]]), ("Bicycle",)))


def test_the_classes_with_boxes_are_those_of_the_boxes_of_detectors() -> None:
    parked = {LABELS["Bicycle"], LABELS["Motorcycle"]}
    assert set(BOXED) == set(LABELS.values()) - parked
    assert set(BOXED) == {LABELS[name] for name in CODES if name in LABELS}


def test_touching_boxes_are_accepted_and_stacked_ones_refused() -> None:
    rows = np.float32(
        [
            [9, 0, -1, 4, 2, 1.5, 0.3],
            [9, 2.0, -1, 4, 2, 1.5, 0.3],
            [9, 0, 3, 4, 2, 1.5, 0],
        ]
    )
    assert overlapping_pairs(Boxes(rows, ("Car",) * 3)) == []
    rows[1, 1] = 1.2
    assert overlapping_pairs(Boxes(rows, ("Car",) * 3)) == [(0, 1)]


def test_many_boxes_in_one_place_are_refused_soon() -> None:
    box = np.array([[12, 0, -0.7, 4.5, 1.8, 1.6, 0.3]], np.float32)
    start = time.process_time()
    with pytest.raises(DataError, match="that overlap"):
        Layout(Boxes(np.repeat(box, 1500, 0), ("Car",) * 1500))
    assert time.process_time() - start < 30


def test_turned_boxes_overlap_as_their_footprints_do() -> None:
    """Two boxes of 4 m by 2 m at a right angle: their sides meet at 3 m from centre to centre."""
    for apart, meet in ((2.7, True), (2.9, False)):
        values = [
            [12, 0, -0.7, 4, 2, 1.6, 0],
            [12 + apart, 0, -0.7, 4, 2, 1.6, np.pi / 2],
        ]
        boxes = Boxes(np.array(values, np.float32), ("Car", "Car"))
        assert overlapping_pairs(boxes) == ([(0, 1)] if meet else [])
