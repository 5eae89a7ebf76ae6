"""Pictures show what is in the scan, and a page carries it whole."""

import base64
import io
import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from click.testing import Result
from conftest import random_scan
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from typer.testing import CliRunner

from lidar_synth.classes import COLOURS, IGNORE, NAMES, TRAIN_ID
from lidar_synth.cli.view import view as command
from lidar_synth.errors import ConfigError, FileError, LibraryError
from lidar_synth.geometry.projection import project, unproject
from lidar_synth.geometry.scan import REAL, SYNTHETIC, Boxes, RangeImage, Scan
from lidar_synth.geometry.sensor import Sensor, load_sensor
from lidar_synth.viz import (
    Camera,
    Orbit,
    bird,
    contact_sheet,
    html_page,
    picture,
    render,
    scales,
    sheet,
    window,
    write_view,
)
from lidar_synth.viz.colour import EMPTY, UNLABELLED, VALUES
from lidar_synth.viz.page import POINT
from lidar_synth.viz.render import box_segments

SMALL = Sensor("small", columns=64, rows=16, fov_up=10.0, fov_down=-30.0, range_min=1.0, range_max=80.0)
CAR, ROAD = TRAIN_ID["car"], TRAIN_ID["road"]


def at(*places: tuple[float, float, float], label: list[int] | None = None, **fields: Any) -> Scan:
    """A scan of a few points."""
    points = np.array(places, np.float32).reshape(-1, 3)
    labels = None if label is None else np.array(label, np.uint8)
    return Scan(points, np.full(len(points), 0.5, np.float32), SMALL, label=labels, id="few", **fields)


def wall(x: float, label: int) -> Scan:
    """A dense 2 m square that stands across the x axis."""
    y, z = np.meshgrid(np.linspace(-1, 1, 121), np.linspace(-1, 1, 121))
    places = np.stack([np.full(y.size, x), y.ravel(), z.ravel()], -1)
    return at(*map(tuple, places), label=[label] * y.size)


def joined(first: Scan, second: Scan) -> Scan:
    both = {n: np.concatenate([first.fields()[n], second.fields()[n]]) for n in first.fields()}
    return replace(first, points=np.concatenate([first.points, second.points]), **both)


def page_data(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert found
    data: dict[str, Any] = json.loads(found[1])
    return data


def pixels(uri: str) -> np.ndarray:
    head, _, content = uri.partition(",")
    assert re.fullmatch(r"data:image/(png|jpeg);base64", head)
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB"))


# Range images


def test_a_picture_shows_every_cell(sensor: Sensor) -> None:
    image = project(random_scan(sensor))
    labels = picture(image, "label")
    assert labels.shape == (*sensor.shape, 3)
    np.testing.assert_array_equal(labels[~image.mask], np.broadcast_to(EMPTY, labels[~image.mask].shape))
    assert image.label is not None
    for train, colour in [*enumerate(COLOURS), (IGNORE, UNLABELLED)]:
        cells = image.mask & (image.label == train)
        np.testing.assert_array_equal(labels[cells], np.broadcast_to(colour, labels[cells].shape))
    for channel in ("range", "reflectance"):
        shown = picture(image, channel)
        assert (shown[~image.mask] == EMPTY).all()
        # What is empty stays apart from the darkest colour of a return.
        assert np.abs(shown[image.mask].astype(int) - EMPTY).sum(-1).min() > 30


def test_colours_follow_the_values() -> None:
    ranges = np.tile(np.linspace(1, 80, 64, dtype=np.float32), (16, 1))
    scale = scales([unproject(RangeImage(ranges, SMALL))])["range"]
    shown = picture(RangeImage(ranges, SMALL), "range", scale)
    np.testing.assert_array_equal(shown[0], scale.table[scale.index(ranges[0])])
    assert (np.diff(scale.index(ranges[0]).astype(int)) >= 0).all()
    assert scale.index(np.array([-5.0, 0.0, 20.0, 80.0, 500.0])).tolist() == [0, 0, 128, 255, 255]  # gamma 1/2


@pytest.mark.parametrize("name", ["height", "range", "reflectance"])
def test_lightness_runs_one_way_along_a_table(name: str) -> None:
    table = scales([random_scan(SMALL)])[name].table.astype(float)
    lightness = (table / 255) ** 2.2 @ [0.2126, 0.7152, 0.0722]
    step = np.diff(lightness) * np.sign(lightness[-1] - lightness[0])
    assert (step > -0.005).all()


def test_a_channel_that_is_not_there_is_an_error() -> None:
    image = project(replace(random_scan(SMALL), label=None))
    with pytest.raises(ConfigError, match="'label'.*one of range, reflectance"):
        picture(image, "label")
    with pytest.raises(ConfigError, match="'depth'"):
        picture(image, "depth")


# The renderer


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("camera", [Camera((-20, 0, 0)), Camera((-20, 0, 0), field=10, parallel=True)])
def test_the_near_point_hides_the_far_one(camera: Camera, order: int) -> None:
    near, far = wall(5, CAR), wall(15, ROAD)
    both = joined(near, far)[np.arange(len(near) + len(far))[::order]]
    seen = render(both, "label", camera=camera, size=(200, 200), rings=False)[100, 100]
    assert np.abs(seen.astype(int) - COLOURS[CAR]).max() < 12
    alone = render(far, "label", camera=camera, size=(200, 200), rings=False)[100, 100]
    assert np.abs(alone.astype(int) - COLOURS[ROAD]).max() < 12


def test_seen_from_the_other_side_the_order_turns() -> None:
    both = joined(wall(5, CAR), wall(15, ROAD))
    seen = render(both, "label", camera=Camera((40, 0, 0)), size=(200, 200), rings=False)[100, 100]
    assert np.abs(seen.astype(int) - COLOURS[ROAD]).max() < 12


def test_from_above_ahead_is_up_and_left_is_left() -> None:
    scan = at((20, 0, 0), (0, 10, 0), label=[CAR, ROAD])
    seen = render(scan, "label", camera=bird(25), size=(500, 500), rings=False).astype(int)
    assert (np.abs(seen[48:52, 248:252] - COLOURS[CAR]).max(-1) < 70).any()  # 20 m: 200 pixels up from the middle
    assert (np.abs(seen[248:252, 148:152] - COLOURS[ROAD]).max(-1) < 70).any()  # 10 m to the left
    far = np.ones((500, 500), bool)
    far[40:60, 240:260] = far[240:260, 140:160] = False
    assert (seen[far] == EMPTY).all()


@settings(max_examples=40)
@given(st.floats(-180, 180), st.floats(-80, 80), st.floats(5, 100))
def test_an_orbit_keeps_its_target_in_the_middle(azimuth: float, elevation: float, distance: float) -> None:
    camera = Orbit(azimuth, elevation, distance, target=(1.0, -2.0, 0.5)).camera()
    pixel, depth, per_metre = camera.look(np.array([(1.0, -2.0, 0.5), (1.0, -2.0, 1.5)]), (640, 480))
    np.testing.assert_allclose(pixel[0], (320, 240), atol=0.01)
    np.testing.assert_allclose(depth[0], distance, rtol=1e-4)
    np.testing.assert_allclose(per_metre[0], 240 / np.tan(np.radians(21)) / distance, rtol=1e-3)
    assert pixel[1, 1] < 240  # z is up
    assert abs(pixel[1, 0] - 320) < 0.01


def test_points_behind_the_camera_are_not_seen() -> None:
    scan = at((-30, 0, 0), (-21, 0.2, 0), label=[CAR, CAR])
    assert (render(scan, "label", camera=Camera((-20, 0, 0)), size=(64, 64), rings=False) == EMPTY).all()


def test_an_edge_casts_shade_on_what_lies_behind_it() -> None:
    """Eye-dome lighting: beside the outline of a near wall the far one is darker than in its own middle."""
    y, z = np.meshgrid(np.linspace(-6, 6, 200), np.linspace(-6, 6, 200))
    back = at(*map(tuple, np.stack([np.full(y.size, 15.0), y.ravel(), z.ravel()], -1)), label=[ROAD] * y.size)
    seen = render(joined(wall(5, CAR), back), "label", camera=Camera((-20, 0, 0)), size=(400, 400), rings=False)
    row = seen[200].astype(int)
    is_car = np.abs(row - COLOURS[CAR]).sum(-1) < 40
    beside = np.flatnonzero(is_car)[-1] + np.arange(1, 4)
    assert np.abs(row[beside[0] + 40] - COLOURS[ROAD]).max() < 12
    assert row[beside].sum(-1).min() < 0.9 * row[beside[0] + 40].sum()


def test_boxes_are_drawn_on_their_edges_and_on_request() -> None:
    boxes = Boxes(np.array([(0, 0, 0, 8, 4, 2, 0)], np.float32), ("Car",))
    scan = at((0, 0, -2), label=[ROAD], boxes=boxes)
    shown = render(scan, "label", camera=bird(10), size=(200, 200), rings=False)
    for row, column in [(60, 100), (140, 90), (100, 80), (100, 120)]:  # front, back, left and right edge
        assert shown[row - 2 : row + 3, column - 2 : column + 3].max() > 180
    assert shown[80, 100].min() > 90, "the line to the front"
    assert shown[120, 100].max() < 90, "none to the back"
    without = render(scan, "label", camera=bird(10), size=(200, 200), rings=False, boxes=False)
    assert (without[60, 95:105] == EMPTY).all()


def test_box_segments_join_the_corners() -> None:
    boxes = Boxes(np.array([(1, 2, 3, 4, 2, 1.5, 0.7), (9, 0, 0, 1, 1, 1, 0)], np.float32), ("Car", "Misc"))
    segments = box_segments(boxes)
    assert segments.shape == (26, 2, 3)
    lengths = np.linalg.norm(segments[:, 0] - segments[:, 1], axis=1)
    np.testing.assert_allclose(np.sort(lengths[:12]), [1.5] * 4 + [2] * 4 + [4] * 4, rtol=1e-5)
    front = segments[24, 1] - segments[24, 0]
    np.testing.assert_allclose(front, (2 * np.cos(0.7), 2 * np.sin(0.7), 0), atol=1e-5)


@pytest.mark.parametrize("by", sorted(VALUES))
def test_every_quantity_colours_points(by: str) -> None:
    scan = random_scan(SMALL)
    seen = render(scan, by, size=(160, 90))
    assert seen.shape == (90, 160, 3)
    assert seen.dtype == np.uint8
    assert (seen != EMPTY).any(-1).mean() > 0.02
    with pytest.raises(ConfigError, match="one of height, range, reflectance, domain"):
        render(replace(scan, label=None), "label", size=(16, 9))
    with pytest.raises(ConfigError, match="colour by 'velocity'"):
        render(scan, "velocity", size=(16, 9))


def test_real_and_synthetic_differ_in_colour() -> None:
    real, synthetic = (render(replace(wall(5, CAR), domain=d), "domain", camera=Camera((-20, 0, 0)), size=(64, 64))
                       for d in (REAL, SYNTHETIC))  # fmt: skip
    assert np.abs(real[32, 32].astype(int) - synthetic[32, 32]).max() > 100


def test_a_scan_without_points_can_be_seen() -> None:
    empty = at(label=[])
    assert (render(empty, "height", size=(32, 18), rings=False) == EMPTY).all()
    assert page_data(html_page([empty]))["scans"][0]["count"] == 0
    sheet(empty)


# Sheets


def rgb(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3]


def test_a_sheet_names_its_scan_and_its_classes() -> None:
    scan = replace(random_scan(SMALL), boxes=Boxes(np.array([(5, 0, 0, 4, 2, 1.5, 0)], np.float32), ("Car",)))
    assert scan.label is not None
    figure = sheet(scan)
    assert f"{len(scan):,} points" in figure.texts[0].get_text()
    [legend] = figure.legends
    named = {text.get_text().rsplit(" ", 1)[0] for text in legend.get_texts()}
    assert named == {NAMES[i] if i < IGNORE else "unlabelled" for i in np.unique(scan.label)}
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert {"range (m)", "reflectance", "label"} <= set(titles)
    above = next(axes for axes in figure.axes if "from above" in axes.get_title(loc="left"))
    assert above.get_xlim() == (50, -50)
    assert above.get_ylim() == (-50, 50)
    shown = rgb(figure)
    for train in np.unique(scan.label[scan.label < IGNORE]):
        assert (shown == COLOURS[train]).all(-1).any(), NAMES[train]


def test_a_sheet_without_labels_has_no_legend_and_no_label_image() -> None:
    figure = sheet(replace(random_scan(SMALL), label=None))
    assert not figure.legends
    assert "label" not in [axes.get_title(loc="left") for axes in figure.axes]


def test_a_sheet_of_a_range_image_shows_its_cells() -> None:
    image = project(random_scan(SMALL))
    figure = sheet(image)
    axes = next(a for a in figure.axes if a.get_title(loc="left") == "label")
    np.testing.assert_array_equal(axes.images[0].get_array(), picture(image, "label"))


def test_many_scans_on_one_sheet() -> None:
    scans = [replace(random_scan(SMALL, seed=i), domain=i % 2) for i in range(5)]
    figure = contact_sheet(scans, title="five")
    captions = [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]
    assert len(captions) == 5
    assert "random-3" in captions[3]
    assert "synthetic" in captions[3]
    assert figure.texts[0].get_text() == "five"
    shown = [axes.images[0].get_array() for axes in figure.axes if axes.images]
    for scan, distance, label in zip(scans, shown[1::3], shown[2::3], strict=True):
        image = project(scan, channels=["label"])
        np.testing.assert_array_equal(label, picture(image, "label"))
        np.testing.assert_array_equal((distance == EMPTY).all(-1), ~image.mask)
    bare = contact_sheet([replace(scan, label=None) for scan in scans])
    assert sum(bool(axes.images) for axes in bare.axes) == 10, "without labels nothing stands for them"
    with pytest.raises(ConfigError, match="no scans"):
        contact_sheet([])


# The page


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    boxes = Boxes(np.array([(5, 1, -1, 4, 2, 1.5, 0.3)], np.float32), ("Car",))
    return [
        replace(random_scan(load_sensor("town"), 3000), boxes=boxes),
        replace(random_scan(load_sensor("os1_128"), 500, seed=1), label=None, domain=SYNTHETIC, id="</script>&<b>"),
    ]


@pytest.fixture(scope="module")
def page(scans: list[Scan]) -> str:
    return html_page(scans, title="A <title> & more", notes="First.\n\nSecond & <last>. @data@")


def test_the_points_come_back_from_the_page(page: str, scans: list[Scan]) -> None:
    for scan, packed in zip(scans, page_data(page)["scans"], strict=True):
        points = np.frombuffer(base64.b64decode(packed["points"]), POINT)
        assert len(points) == len(scan) == packed["count"]
        step = packed["metres"]
        assert step <= np.abs(scan.points).max() / 32767 * 1.001
        np.testing.assert_allclose(points["cell"] * step, scan.points, atol=step / 2 * 1.01)
        np.testing.assert_allclose(points["reflectance"] / 255, scan.reflectance, atol=0.5 / 255 + 1e-6)
        expected = np.full(len(scan), IGNORE) if scan.label is None else scan.label
        np.testing.assert_array_equal(points["label"], expected)


def test_a_packed_point_is_eight_bytes_without_gaps() -> None:
    """The viewer reads three int16 at 0 and two uint8 at 6."""
    assert POINT.itemsize == 8
    assert {name: place for name, (_, place) in POINT.fields.items()} == {"cell": 0, "reflectance": 6, "label": 7}


def test_the_page_says_what_each_scan_is(page: str, scans: list[Scan]) -> None:
    first, second = page_data(page)["scans"]
    assert (first["id"], second["id"]) == ("random-0", "</script>&<b>")
    assert (first["domain"], second["domain"]) == (REAL, SYNTHETIC)
    assert (first["sensor"], second["sensor"]) == ("town", "os1_128")
    assert "label" in first["colours"]
    assert "label" not in second["colours"]
    assert scans[0].label is not None
    assert first["classes"][TRAIN_ID["road"]] == (scans[0].label == ROAD).sum()
    assert sum(first["classes"]) == len(scans[0])
    lines = np.frombuffer(base64.b64decode(first["boxes"]), "<f4").reshape(-1, 2, 3)
    np.testing.assert_array_equal(lines, box_segments(scans[0].boxes))
    assert second["boxes"] == ""


def test_the_page_carries_the_range_images(page: str, scans: list[Scan]) -> None:
    colours = scales(scans)
    for scan, packed in zip(scans, page_data(page)["scans"], strict=True):
        image = project(scan)
        channels = ["range", "reflectance"] + ["label"] * (scan.label is not None)
        assert [p["title"] for p in packed["pictures"]] == [colours[c].title for c in channels]
        for channel, shown in zip(channels, packed["pictures"], strict=True):
            np.testing.assert_array_equal(pixels(shown["uri"]), picture(image, channel, colours[channel]))
        assert pixels(packed["still"]).shape == (540, 960, 3)


def test_the_page_colours_as_the_pictures_do(page: str, scans: list[Scan]) -> None:
    data, colours = page_data(page), scales(scans)
    table = np.frombuffer(base64.b64decode(data["table"]), np.uint8).reshape(len(colours), 256, 3)
    assert list(data["scales"]) == list(VALUES) == list(colours)
    for name, scale in colours.items():
        row = data["scales"][name]
        np.testing.assert_array_equal(table[row["row"]], scale.table)
        assert (row["low"], row["high"], row["gamma"]) == (scale.low, scale.high, scale.gamma)
    np.testing.assert_array_equal(table[data["scales"]["label"]["row"], :19], COLOURS)


def test_the_page_needs_nothing_from_outside(page: str) -> None:
    markup = page.replace(json.dumps(page_data(page)), "")
    assert not re.search(r"https?:|//cdn|@import|import\s*\(|\bfetch\b|XMLHttpRequest|<link|src=[\"'](?!data:)", markup)
    assert not re.search(r"@(title|notes|draw|script)@", page)


def test_text_of_the_user_is_text_on_the_page(page: str) -> None:
    assert "<title>A &lt;title&gt; &amp; more</title>" in page
    assert "<p>First.</p><p>Second &amp; &lt;last&gt;. @data@</p>" in page
    assert page.count("</script>") == 3, "an id cannot end the data"


def test_a_camera_image_stands_on_the_page_where_there_is_one(tmp_path: Path) -> None:
    Image.new("RGB", (1408, 376), (10, 200, 30)).save(tmp_path / "camera.png")
    with_image = replace(random_scan(SMALL), image_path=tmp_path / "camera.png")
    [scan] = page_data(html_page([with_image]))["scans"]
    photo = pixels(scan["pictures"][-1]["uri"])
    assert photo.shape[1] == 1200
    assert np.abs(photo.astype(int) - (10, 200, 30)).max() < 8
    lost = replace(with_image, image_path=tmp_path / "lost.png")
    assert "camera" not in [p["title"] for p in page_data(html_page([lost]))["scans"][0]["pictures"]]


def test_a_full_scan_is_small_enough_to_send() -> None:
    """120,000 points in 8 bytes each and base64; noise is the worst case for its pictures."""
    page = html_page([random_scan(load_sensor("hdl64e_kitti360"), 120_000)])
    assert len(page_data(page)["scans"][0]["points"]) == 120_000 * 8 * 4 / 3
    assert len(page) < 2.4e6


def test_the_page_has_every_element_that_its_script_asks_for() -> None:
    folder = files("lidar_synth.viz")
    asked = set(re.findall(r'\$\("(\w+)"\)', folder.joinpath("page.js").read_text()))
    there = set(re.findall(r'id="(\w+)"', folder.joinpath("page.html").read_text()))
    assert len(asked) >= 10
    assert asked <= there


# Files and the command line


def test_files_are_written_whole(tmp_path: Path) -> None:
    scans = [random_scan(SMALL, seed=i) for i in range(2)]
    write_view(tmp_path / "one.png", scans[:1])
    write_view(tmp_path / "two.png", scans)
    write_view(tmp_path / "two.html", scans, title="Two")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["one.png", "two.html", "two.png"]
    assert Image.open(tmp_path / "one.png").size[0] == 1700
    assert "<title>Two</title>" in (tmp_path / "two.html").read_text(encoding="utf-8")


def test_what_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"out\.jpg; expected a file that ends in \.png or \.html"):
        write_view(tmp_path / "out.jpg", [random_scan(SMALL)])
    with pytest.raises(ConfigError, match="no scans"):
        write_view(tmp_path / "out.png", [])
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="cannot be written"):
        write_view(tmp_path / "file" / "out.html", [random_scan(SMALL)])


View = Callable[..., Result]


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> View:
    """Runs ``lidar-synth view`` on a folder with three scans, in an empty folder and without a screen."""
    data = tmp_path / "data"
    data.mkdir()
    for i in range(3):
        scan = random_scan(load_sensor("town"), 400, seed=i)
        np.column_stack([scan.points, scan.reflectance]).astype("<f4").tofile(data / f"{i:06}.bin")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(window, "has_screen", lambda: False)
    app = typer.Typer()
    app.command()(command)
    return lambda *args: CliRunner().invoke(app, [str(data), *args], catch_exceptions=True)


def test_view_writes_a_page_where_there_is_no_screen(view: View) -> None:
    result = view("--index", "1")
    assert result.exit_code == 0, result.output
    [page] = Path().iterdir()
    assert page.name == "data-1.html"
    assert result.stdout.startswith("data-1.html: 1 of the scans in")
    [scan] = page_data(page.read_text(encoding="utf-8"))["scans"]
    assert "000001" in scan["id"]
    assert scan["count"] == 400


@pytest.mark.parametrize(("args", "ids"), [
    (["--index", "-1"], ["000002"]), (["--index", "-3", "--count", "2"], ["000000", "000001"]),
    (["--count", "9"], ["000000", "000001", "000002"]),
])  # fmt: skip
def test_view_takes_the_scans_that_are_asked_for(view: View, args: list[str], ids: list[str]) -> None:
    assert view(*args, "--out", "out.html").exit_code == 0
    shown = page_data(Path("out.html").read_text(encoding="utf-8"))["scans"]
    assert [scan["id"][-6:] for scan in shown] == ids


def test_view_takes_a_sensor_and_writes_a_sheet(view: View) -> None:
    assert view("--sensor", "os1_128", "--out", "one.html").exit_code == 0
    [scan] = page_data(Path("one.html").read_text(encoding="utf-8"))["scans"]
    assert scan["sensor"] == "os1_128"
    assert pixels(scan["pictures"][0]["uri"]).shape == (128, 1024, 3)
    assert view("--count", "3", "--out", "all.png").exit_code == 0
    assert Image.open("all.png").size[0] == 920


@pytest.mark.parametrize(("args", "message"), [
    (["--index", "3"], r"--index 3: .* holds 3 scans; expected 0 \.\. 2"),
    (["--index", "-4"], r"--index -4: .* holds 3 scans"),
    (["--out", "scan.jpg"], r"scan\.jpg; expected a file that ends in \.png or \.html"),
    (["--sensor", "velodyne"], r"sensor 'velodyne'; expected one of"),
])  # fmt: skip
def test_a_wrong_call_says_what_is_right(view: View, args: list[str], message: str) -> None:
    result = view(*args)
    assert isinstance(result.exception, ConfigError)
    assert re.search(message, str(result.exception))
    assert not list(Path().iterdir())


# The window


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="a screen is always there")
def test_no_window_where_no_display_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A DISPLAY that leads nowhere is no screen: open3d would wait there for ever."""
    monkeypatch.setenv("DISPLAY", ":4242")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    assert not window.has_screen()
    assert not window.show([random_scan(SMALL)])


def test_no_window_without_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "has_screen", lambda: True)
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert not window.show([random_scan(SMALL)])


def test_what_the_window_draws() -> None:
    try:
        window.import_open3d()
    except LibraryError as error:
        pytest.skip(str(error))
    boxes = Boxes(np.array([(5, 1, -1, 4, 2, 1.5, 0.3)], np.float32), ("Car",))
    scan = replace(random_scan(SMALL), boxes=boxes)
    cloud, lines = window.geometries(scan, scales([scan]))
    np.testing.assert_array_equal(np.asarray(cloud.points).astype(np.float32), scan.points)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255, scales([scan])["label"](scan.label), atol=1e-4)
    drawn = np.asarray(lines.points)[np.asarray(lines.lines)]
    np.testing.assert_allclose(drawn, box_segments(boxes), atol=1e-6)
    assert len(window.geometries(replace(scan, boxes=None), scales([scan]))) == 1
