"""The HTML page: self-contained, with the same points, range images and colours as the pictures."""

import base64
import json
import re
import zlib
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import random_scan
from pictures import ROAD, SMALL, page_data, pixels
from PIL import Image

from lidar_synth.datasets.classes import IGNORE, TRAIN_ID
from lidar_synth.datasets.colours import COLOURS
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import REAL, SYNTHETIC, Boxes, Scan
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.viz import (
    html_page,
    make_scales,
    picture,
)
from lidar_synth.viz.page import SCRIPTS, pack
from lidar_synth.viz.render import box_segments
from lidar_synth.viz.scales import VALUES

PANELS = ["<section>one</section>", "<section>two, @data@</section>"]


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    boxes = Boxes(np.array([(5, 1, -1, 4, 2, 1.5, 0.3)], np.float32), ("Car",))
    return [
        replace(random_scan(load_sensor("town"), 3000), boxes=boxes),
        replace(
            random_scan(load_sensor("os1_128"), 500, seed=1),
            label=None,
            domain=SYNTHETIC,
            id="</script>&<b>",
            confidence=np.linspace(0, 1, 500, dtype=np.float32),
        ),
    ]


@pytest.fixture(scope="module")
def page(scans: list[Scan]) -> str:
    return html_page(
        scans,
        title="A <title> & more",
        notes="First.\n\nSecond & <last>. @data@",
        panels=PANELS,
    )


def unpacked(scan: dict[str, Any]) -> list[np.ndarray]:
    """x, y, z in metres, reflectance and label of a scan of a page, and its confidence if it has
    it."""
    content = zlib.decompress(base64.b64decode(scan["points"]))
    count = scan["count"]
    steps = np.frombuffer(content, "<i2", 3 * count).reshape(3, count)
    bytes_ = np.frombuffer(content, np.uint8, offset=6 * count).reshape(-1, count)
    return [
        *np.cumsum(steps, axis=1, dtype=np.int16) * scan["metres"],
        bytes_[0] / 255,
        bytes_[1],
        *bytes_[2:] / 255,
    ]


@pytest.mark.slow
def test_the_page_contains_all_points(page: str, scans: list[Scan]) -> None:
    for scan, packed in zip(scans, page_data(page)["scans"], strict=True):
        x, y, z, reflectance, label, *confidence = unpacked(packed)
        step = packed["metres"]
        assert step <= np.abs(scan.points).max() / 32767 * 1.001
        np.testing.assert_allclose(
            np.stack([x, y, z], 1), scan.points, atol=step / 2 * 1.01
        )
        np.testing.assert_allclose(reflectance, scan.reflectance, atol=0.5 / 255 + 1e-6)
        np.testing.assert_array_equal(
            label, np.full(len(scan), IGNORE) if scan.label is None else scan.label
        )
        assert len(confidence) == (scan.confidence is not None)
        if scan.confidence is not None:
            np.testing.assert_allclose(
                confidence[0], scan.confidence, atol=0.5 / 255 + 1e-6
            )


def test_one_far_point_leaves_the_others_where_they_are(scans: list[Scan]) -> None:
    scan = scans[0]
    points = scan.points.copy()
    points[0, 0] = 65535
    packed, metres = pack(replace(scan, points=points))
    steps = np.frombuffer(zlib.decompress(packed), "<i2", len(scan))
    x = np.cumsum(steps, dtype=np.int16) * metres
    assert metres <= 4 * scan.sensor.range_max / 32767 <= x[0]
    assert np.abs(x[1:] - points[1:, 0]).max() <= metres


def test_labels_of_any_integers_are_packed_as_bytes(scans: list[Scan]) -> None:
    """Predictions of a network are int64."""
    scan = next(s for s in scans if s.label is not None)
    assert pack(replace(scan, label=scan.label.astype(np.int64))) == pack(scan)


def test_the_page_contains_the_facts_of_each_scan(page: str, scans: list[Scan]) -> None:
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


def test_the_page_contains_the_range_images(page: str, scans: list[Scan]) -> None:
    colours = make_scales(scans)
    for scan, packed in zip(scans, page_data(page)["scans"], strict=True):
        image = project(scan)
        own = [name for name in ("label", "confidence") if name in scan.fields()]
        channels = ["range", "reflectance", *own]
        assert [p["title"] for p in packed["pictures"]] == [
            colours[c].title for c in channels
        ]
        for channel, shown in zip(channels, packed["pictures"], strict=True):
            np.testing.assert_array_equal(
                pixels(shown["uri"]), picture(image, channel, colours[channel])
            )
        assert pixels(packed["still"]).shape == (360, 640, 3)


def test_the_page_uses_the_colour_tables_of_the_pictures(
    page: str, scans: list[Scan]
) -> None:
    data = page_data(page)
    colours = make_scales(scans)
    table = np.frombuffer(base64.b64decode(data["table"]), np.uint8).reshape(
        len(colours), 256, 3
    )
    assert list(data["scales"]) == list(VALUES) == list(colours)
    for name, scale in colours.items():
        row = data["scales"][name]
        np.testing.assert_array_equal(table[row["row"]], scale.table)
        assert (row["low"], row["high"], row["gamma"]) == (
            scale.low,
            scale.high,
            scale.gamma,
        )
    np.testing.assert_array_equal(table[data["scales"]["label"]["row"], :19], COLOURS)


def test_the_page_loads_nothing_from_outside(page: str) -> None:
    markup = page.replace(json.dumps(page_data(page)), "")
    assert not re.search(
        r"https?:|//cdn|@import|import\s*\(|\bfetch\b|XMLHttpRequest|<link|src=[\"'](?!data:)",
        markup,
    )
    assert not re.search(r"@(title|notes|script)@", page)


def test_user_text_is_escaped_on_the_page(page: str) -> None:
    assert "<title>A &lt;title&gt; &amp; more</title>" in page
    assert "<p>First.</p><p>Second &amp; &lt;last&gt;. @data@</p>" in page
    assert page.count("</script>") == 2, "an id cannot end the data"


def test_an_existing_camera_image_is_shown_on_the_page(tmp_path: Path) -> None:
    Image.new("RGB", (1408, 376), (10, 200, 30)).save(tmp_path / "camera.png")
    with_image = replace(random_scan(SMALL), image_path=tmp_path / "camera.png")
    [scan] = page_data(html_page([with_image]))["scans"]
    photo = pixels(scan["pictures"][-1]["uri"])
    assert photo.shape[1] == 1200
    assert np.abs(photo.astype(int) - (10, 200, 30)).max() < 8
    lost = replace(with_image, image_path=tmp_path / "lost.png")
    assert "camera" not in [
        p["title"] for p in page_data(html_page([lost]))["scans"][0]["pictures"]
    ]


def test_panels_stand_on_the_page_as_they_are(page: str) -> None:
    assert f'<div id="panels">{"".join(PANELS)}</div>' in page


def test_domains_can_have_other_names(scans: list[Scan]) -> None:
    assert page_data(html_page(scans[1:]))["domains"] == ["real", "synthetic"]
    assert page_data(html_page(scans[1:], domains=("town", "made")))["domains"] == [
        "town",
        "made",
    ]


def test_a_page_with_a_full_scan_is_below_2_1_megabytes() -> None:
    """120,000 points; noise is the worst case for its points and pictures."""
    page = html_page([random_scan(load_sensor("hdl64e_kitti360"), 120_000)])
    assert page_data(page)["scans"][0]["count"] == 120_000
    assert len(page) < 2.1e6


def test_the_page_has_every_element_that_its_script_uses() -> None:
    folder = files("lidar_synth.viz")
    scripts = "".join(folder.joinpath(name).read_text() for name in SCRIPTS)
    asked = set(re.findall(r'\$\("(\w+)"\)', scripts))
    there = set(re.findall(r'id="(\w+)"', folder.joinpath("page.html").read_text()))
    assert len(asked) >= 10
    assert asked <= there
