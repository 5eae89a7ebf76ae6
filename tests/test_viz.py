"""Pictures, rendered views and sheets show the content of a scan."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import random_scan
from hypothesis import given, settings, strategies as st
from pictures import CAR, ROAD, SMALL, page_data
from PIL import Image

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.datasets.colours import COLOURS
from lidar_synth.errors import ConfigError, DataError, FileError
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import REAL, SYNTHETIC, Boxes, RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.viz import (
    Camera,
    Orbit,
    bird,
    contact_sheet,
    html_page,
    make_scales,
    picture,
    render,
    sheet,
    write_view,
)
from lidar_synth.viz.render import box_segments
from lidar_synth.viz.scales import EMPTY, UNLABELLED, VALUES


def few_points(
    *places: tuple[float, float, float], label: list[int] | None = None, **fields: Any
) -> Scan:
    """A scan of a few points."""
    points = np.array(places, np.float32).reshape(-1, 3)
    labels = None if label is None else np.array(label, np.uint8)
    return Scan(
        points,
        np.full(len(points), 0.5, np.float32),
        SMALL,
        label=labels,
        id="few",
        **fields,
    )


def wall(x: float, label: int) -> Scan:
    """A dense 2 m square perpendicular to the x axis."""
    y, z = np.meshgrid(np.linspace(-1, 1, 121), np.linspace(-1, 1, 121))
    places = np.stack([np.full(y.size, x), y.ravel(), z.ravel()], -1)
    return few_points(*map(tuple, places), label=[label] * y.size)


def joined(first: Scan, second: Scan) -> Scan:
    both = {
        n: np.concatenate([first.fields()[n], second.fields()[n]])
        for n in first.fields()
    }
    return replace(first, points=np.concatenate([first.points, second.points]), **both)


def test_a_picture_has_the_colour_of_every_cell(sensor: Sensor) -> None:
    image = project(random_scan(sensor))
    labels = picture(image, "label")
    assert labels.shape == (*sensor.shape, 3)
    np.testing.assert_array_equal(
        labels[~image.mask], np.broadcast_to(EMPTY, labels[~image.mask].shape)
    )
    assert image.label is not None
    for train, colour in [*enumerate(COLOURS), (IGNORE, UNLABELLED)]:
        cells = image.mask & (image.label == train)
        np.testing.assert_array_equal(
            labels[cells], np.broadcast_to(colour, labels[cells].shape)
        )
    for channel in ("range", "reflectance"):
        pixels = picture(image, channel)
        assert (pixels[~image.mask] == EMPTY).all()
        # The colour of an empty cell differs clearly from the darkest colour of a return.
        assert np.abs(pixels[image.mask].astype(int) - EMPTY).sum(-1).min() > 30


def test_colours_increase_with_the_values() -> None:
    ranges = np.tile(np.linspace(1, 80, 64, dtype=np.float32), (16, 1))
    scale = make_scales([unproject(RangeImage(ranges, SMALL))])["range"]
    pixels = picture(RangeImage(ranges, SMALL), "range", scale)
    np.testing.assert_array_equal(pixels[0], scale.table[scale.index(ranges[0])])
    assert (np.diff(scale.index(ranges[0]).astype(int)) >= 0).all()
    # Gamma 1/2.
    assert scale.index(np.array([-5.0, 0.0, 20.0, 80.0, 500.0])).tolist() == [
        0,
        0,
        128,
        255,
        255,
    ]


@pytest.mark.parametrize("name", ["height", "range", "reflectance"])
def test_lightness_is_monotonic_along_a_colour_table(name: str) -> None:
    table = make_scales([random_scan(SMALL)])[name].table.astype(float)
    lightness = (table / 255) ** 2.2 @ [0.2126, 0.7152, 0.0722]
    step = np.diff(lightness) * np.sign(lightness[-1] - lightness[0])
    assert (step > -0.005).all()


def test_a_missing_or_unknown_channel_is_refused() -> None:
    image = project(replace(random_scan(SMALL), label=None))
    with pytest.raises(ConfigError, match="'label'.*one of 'range', 'reflectance'"):
        picture(image, "label")
    with pytest.raises(ConfigError, match="'depth'"):
        picture(image, "depth")


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(
    "camera", [Camera((-20, 0, 0)), Camera((-20, 0, 0), field=10, parallel=True)]
)
def test_the_near_point_hides_the_far_one(camera: Camera, order: int) -> None:
    near = wall(5, CAR)
    far = wall(15, ROAD)
    both = joined(near, far)[np.arange(len(near) + len(far))[::order]]
    pixels = render(both, "label", camera=camera, size=(200, 200), rings=False)[
        100, 100
    ]
    assert np.abs(pixels.astype(int) - COLOURS[CAR]).max() < 12
    alone = render(far, "label", camera=camera, size=(200, 200), rings=False)[100, 100]
    assert np.abs(alone.astype(int) - COLOURS[ROAD]).max() < 12


def test_from_the_other_side_the_far_point_hides_the_near_one() -> None:
    both = joined(wall(5, CAR), wall(15, ROAD))
    pixels = render(
        both, "label", camera=Camera((40, 0, 0)), size=(200, 200), rings=False
    )[100, 100]
    assert np.abs(pixels.astype(int) - COLOURS[ROAD]).max() < 12


def test_from_above_ahead_is_up_and_left_is_left() -> None:
    scan = few_points((20, 0, 0), (0, 10, 0), label=[CAR, ROAD])
    pixels = render(
        scan, "label", camera=bird(25), size=(500, 500), rings=False
    ).astype(int)
    assert (
        np.abs(pixels[48:52, 248:252] - COLOURS[CAR]).max(-1) < 70
    ).any()  # 20 m: 200 pixels up from the middle
    assert (
        np.abs(pixels[248:252, 148:152] - COLOURS[ROAD]).max(-1) < 70
    ).any()  # 10 m to the left
    far = np.ones((500, 500), bool)
    far[40:60, 240:260] = far[240:260, 140:160] = False
    assert (pixels[far] == EMPTY).all()


@settings(max_examples=40)
@given(st.floats(-180, 180), st.floats(-80, 80), st.floats(5, 100))
def test_an_orbit_keeps_its_target_in_the_centre(
    azimuth: float, elevation: float, distance: float
) -> None:
    camera = Orbit(azimuth, elevation, distance, target=(1.0, -2.0, 0.5)).camera()
    pixel, depth, per_metre = camera.look(
        np.array([(1.0, -2.0, 0.5), (1.0, -2.0, 1.5)]), (640, 480)
    )
    np.testing.assert_allclose(pixel[0], (320, 240), atol=0.01)
    np.testing.assert_allclose(depth[0], distance, rtol=1e-4)
    np.testing.assert_allclose(
        per_metre[0], 240 / np.tan(np.radians(21)) / distance, rtol=1e-3
    )
    assert pixel[1, 1] < 240  # z is up
    assert abs(pixel[1, 0] - 320) < 0.01


def test_points_behind_the_camera_are_not_drawn() -> None:
    scan = few_points((-30, 0, 0), (-21, 0.2, 0), label=[CAR, CAR])
    assert (
        render(scan, "label", camera=Camera((-20, 0, 0)), size=(64, 64), rings=False)
        == EMPTY
    ).all()


def test_eye_dome_lighting_darkens_the_background_of_an_edge() -> None:
    """Eye-dome lighting: next to the outline of a near wall, the far wall is darker than
    elsewhere."""
    y, z = np.meshgrid(np.linspace(-6, 6, 200), np.linspace(-6, 6, 200))
    back = few_points(
        *map(tuple, np.stack([np.full(y.size, 15.0), y.ravel(), z.ravel()], -1)),
        label=[ROAD] * y.size,
    )
    pixels = render(
        joined(wall(5, CAR), back),
        "label",
        camera=Camera((-20, 0, 0)),
        size=(400, 400),
        rings=False,
    )
    row = pixels[200].astype(int)
    is_car = np.abs(row - COLOURS[CAR]).sum(-1) < 40
    beside = np.flatnonzero(is_car)[-1] + np.arange(1, 4)
    assert np.abs(row[beside[0] + 40] - COLOURS[ROAD]).max() < 12
    assert row[beside].sum(-1).min() < 0.9 * row[beside[0] + 40].sum()


def test_boxes_are_drawn_along_their_edges_unless_switched_off() -> None:
    boxes = Boxes(np.array([(0, 0, 0, 8, 4, 2, 0)], np.float32), ("Car",))
    scan = few_points((0, 0, -2), label=[ROAD], boxes=boxes)
    pixels = render(scan, "label", camera=bird(10), size=(200, 200), rings=False)
    for row, column in [
        (60, 100),
        (140, 90),
        (100, 80),
        (100, 120),
    ]:  # front, back, left and right edge
        assert pixels[row - 2 : row + 3, column - 2 : column + 3].max() > 180
    assert pixels[80, 100].min() > 90, "the line to the front"
    assert pixels[120, 100].max() < 90, "none to the back"
    without = render(
        scan, "label", camera=bird(10), size=(200, 200), rings=False, boxes=False
    )
    assert (without[60, 95:105] == EMPTY).all()


def test_box_segments_connect_the_corners() -> None:
    boxes = Boxes(
        np.array([(1, 2, 3, 4, 2, 1.5, 0.7), (9, 0, 0, 1, 1, 1, 0)], np.float32),
        ("Car", "Misc"),
    )
    segments = box_segments(boxes)
    assert segments.shape == (26, 2, 3)
    lengths = np.linalg.norm(segments[:, 0] - segments[:, 1], axis=1)
    np.testing.assert_allclose(
        np.sort(lengths[:12]), [1.5] * 4 + [2] * 4 + [4] * 4, rtol=1e-5
    )
    front = segments[24, 1] - segments[24, 0]
    np.testing.assert_allclose(front, (2 * np.cos(0.7), 2 * np.sin(0.7), 0), atol=1e-5)


@pytest.mark.parametrize("by", sorted(VALUES))
def test_points_can_be_coloured_by_every_quantity(by: str) -> None:
    scan = random_scan(SMALL)
    scan = replace(scan, confidence=scan.reflectance)
    pixels = render(scan, by, size=(160, 90))
    assert pixels.shape == (90, 160, 3)
    assert pixels.dtype == np.uint8
    assert (pixels != EMPTY).any(-1).mean() > 0.02
    with pytest.raises(
        ConfigError, match="one of height, range, reflectance, confidence, domain"
    ):
        render(replace(scan, label=None), "label", size=(16, 9))
    with pytest.raises(ConfigError, match="colour by 'velocity'"):
        render(scan, "velocity", size=(16, 9))


def test_real_and_synthetic_differ_in_colour() -> None:
    real, synthetic = (
        render(
            replace(wall(5, CAR), domain=d),
            "domain",
            camera=Camera((-20, 0, 0)),
            size=(64, 64),
        )
        for d in (REAL, SYNTHETIC)
    )
    assert np.abs(real[32, 32].astype(int) - synthetic[32, 32]).max() > 100


@pytest.mark.slow
def test_an_empty_scan_can_be_shown() -> None:
    empty = few_points(label=[])
    assert (render(empty, "height", size=(32, 18), rings=False) == EMPTY).all()
    assert page_data(html_page([empty]))["scans"][0]["count"] == 0
    sheet(empty)


def rgb(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3]


@pytest.mark.slow
def test_a_sheet_shows_its_scan_its_views_and_its_classes() -> None:
    scan = replace(
        random_scan(SMALL),
        boxes=Boxes(np.array([(5, 0, 0, 4, 2, 1.5, 0)], np.float32), ("Car",)),
    )
    assert scan.label is not None
    figure = sheet(scan)
    assert f"{len(scan):,} points" in figure.texts[0].get_text()
    [legend] = figure.legends
    named = {text.get_text().rsplit(" ", 1)[0] for text in legend.get_texts()}
    assert named == {
        NAMES[i] if i < IGNORE else "unlabelled" for i in np.unique(scan.label)
    }
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert {"range (m)", "reflectance", "label"} <= set(titles)
    above = next(
        axes for axes in figure.axes if "from above" in axes.get_title(loc="left")
    )
    assert above.get_xlim() == (50, -50)
    assert above.get_ylim() == (-50, 50)
    pixels = rgb(figure)
    for train in np.unique(scan.label[scan.label < IGNORE]):
        assert (pixels == COLOURS[train]).all(-1).any(), NAMES[train]


def test_a_sheet_without_labels_has_no_legend_and_no_label_image() -> None:
    figure = sheet(replace(random_scan(SMALL), label=None))
    assert not figure.legends
    assert "label" not in [axes.get_title(loc="left") for axes in figure.axes]


def test_a_sheet_of_a_range_image_shows_its_cells() -> None:
    image = project(random_scan(SMALL))
    figure = sheet(image)
    axes = next(a for a in figure.axes if a.get_title(loc="left") == "label")
    np.testing.assert_array_equal(axes.images[0].get_array(), picture(image, "label"))


@pytest.mark.slow
def test_a_contact_sheet_shows_every_scan() -> None:
    scans = [replace(random_scan(SMALL, seed=i), domain=i % 2) for i in range(5)]
    figure = contact_sheet(scans, title="five")
    captions = [
        axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")
    ]
    assert len(captions) == 5
    assert "random-3" in captions[3]
    assert "synthetic" in captions[3]
    assert figure.texts[0].get_text() == "five"
    pixels = [axes.images[0].get_array() for axes in figure.axes if axes.images]
    for scan, distance, label in zip(scans, pixels[1::3], pixels[2::3], strict=True):
        image = project(scan, channels=["label"])
        np.testing.assert_array_equal(label, picture(image, "label"))
        np.testing.assert_array_equal((distance == EMPTY).all(-1), ~image.mask)
    bare = contact_sheet([replace(scan, label=None) for scan in scans])
    assert sum(bool(axes.images) for axes in bare.axes) == 10, (
        "without labels there is no label image"
    )
    with pytest.raises(ConfigError, match="no scans"):
        contact_sheet([])


def test_captions_of_tiles_are_short_and_name_augmentations() -> None:
    """A caption is no wider than its tile, and long ids differ at both ends."""
    scan = replace(random_scan(SMALL, 50, 0), label=None)
    long = replace(scan, id=f"n015-2018{'0' * 60}651")
    figure = contact_sheet([long, replace(scan, id="few").noted("fog", visibility=30)])
    figure.canvas.draw()
    tiles = [axes for axes in figure.axes if axes.get_title(loc="left")]
    text, fog = (axes.get_title(loc="left") for axes in tiles)
    assert text.startswith("n015-2018") and text.endswith("651  ·  real")
    assert fog == "few  ·  real  ·  fog"
    for axes in tiles:
        assert axes.get_tightbbox().width <= axes.get_window_extent().width + 1


def test_a_camera_straight_above_shows_ahead_up() -> None:
    scan = random_scan(SMALL)
    above = Camera((0.0, 0.0, 50.0))
    ahead = replace(above, up=(1.0, 0.0, 0.0))
    assert np.array_equal(above.axes(), ahead.axes())
    assert np.isfinite(Camera((9.0, 0, 0), up=(1.0, 0, 0)).axes()).all()
    assert render(scan, camera=above, size=(64, 36)).max() > 100


@pytest.mark.slow
def test_pictures_and_pages_are_written_to_files(tmp_path: Path) -> None:
    scans = [random_scan(SMALL, seed=i) for i in range(2)]
    write_view(tmp_path / "one.png", scans[:1])
    write_view(tmp_path / "two.png", scans)
    write_view(tmp_path / "two.html", scans, title="Two")
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "one.png",
        "two.html",
        "two.png",
    ]
    assert Image.open(tmp_path / "one.png").size[0] == 1700
    assert "<title>Two</title>" in (tmp_path / "two.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("scale", [255, np.nan])
@pytest.mark.parametrize("field", ["points", "reflectance"])
@pytest.mark.parametrize("suffix", ["png", "html"])
def test_values_that_are_none_are_refused(
    suffix: str, field: str, scale: float, tmp_path: Path
) -> None:
    scan = random_scan(SMALL)
    if field == "points" and scale == 255:
        scale = np.inf
    wrong = replace(scan, **{field: getattr(scan, field) * np.float32(scale)})
    with pytest.raises(DataError, match=f"{field} (that are NaN|of ).*expected"):
        write_view(tmp_path / f"out.{suffix}", [scan, wrong])


@pytest.mark.parametrize("suffix", ["PNG", "html"])
def test_labels_that_are_no_classes_are_refused(suffix: str, tmp_path: Path) -> None:
    scan = random_scan(SMALL)
    wrong = replace(scan, label=np.full(len(scan), 77, np.uint8))
    for shown in (wrong, project(wrong, channels=["label"])):
        with pytest.raises(DataError, match=r"labels \[77\]; expected train ids"):
            write_view(tmp_path / f"out.{suffix}", [scan, shown])
    write_view(tmp_path / f"out.{suffix}", [scan])
    assert (tmp_path / f"out.{suffix}").is_file()


def test_invalid_paths_and_empty_lists_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"out\.jpg; expected a file that ends in \.png or \.html"
    ):
        write_view(tmp_path / "out.jpg", [random_scan(SMALL)])
    with pytest.raises(ConfigError, match="no scans"):
        write_view(tmp_path / "out.png", [])
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="cannot be written"):
        write_view(tmp_path / "file" / "out.html", [random_scan(SMALL)])


@pytest.mark.parametrize("name", [r"$\frac", "a$b$c", r"$$_{"])
def test_names_of_scans_are_no_formulas(name: str, tmp_path: Path) -> None:
    scan = replace(random_scan(SMALL, 50, 0), id=name)
    for number, figure in enumerate(
        (sheet(scan), contact_sheet([scan, scan], title=name))
    ):
        path = tmp_path / f"{number}.png"
        figure.savefig(path)
        assert path.stat().st_size > 1000
