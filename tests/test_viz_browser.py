"""The HTML page in a real browser: two views with one camera, picking, keys, narrow windows."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import Page, running
from conftest import random_scan
from pictures import SMALL

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.geometry.scan import REAL, SYNTHETIC, Boxes, Scan
from lidar_synth.viz import Orbit, html_page

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    yield from running()


def scan(seed: int, domain: int, count: int = 1500) -> Scan:
    """A random scan; a real one has boxes, a synthetic one has confidence."""
    made = replace(random_scan(SMALL, count, seed), domain=domain)
    if domain == REAL:
        return replace(
            made,
            boxes=Boxes(np.array([(5, 1, -1, 4, 2, 1.5, 0.3)], np.float32), ("Car",)),
        )
    return replace(
        made, confidence=np.random.default_rng(seed).random(count).astype(np.float32)
    )


REALS = [scan(seed, REAL) for seed in (0, 1, 2)]
SYNTHETICS = [scan(seed, SYNTHETIC) for seed in (3, 4)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages of these tests."""
    out = tmp_path_factory.mktemp("pages")
    pages = {
        "pair": REALS + SYNTHETICS,
        "one": SYNTHETICS[:1],
        "bare": [replace(s, label=None, boxes=None) for s in REALS[:2]],
        "empty": [REALS[0][:0], SYNTHETICS[0]],
        "overlap": [behind_each_other()],
    }
    for name, scans in pages.items():
        (out / f"{name}.html").write_text(
            html_page(scans, title=name), encoding="utf-8"
        )
    return out


@pytest.fixture
def page(driver: Any, folder: Path) -> Page:
    return Page(driver, folder / "pair.html")


def behind_each_other() -> Scan:
    """Three points on one line of sight of the first camera, the nearest one second in the file."""
    eye = np.array(Orbit().camera().eye)
    target = np.array(Orbit().target)
    points = [eye + share * (target - eye) for share in (1.3, 0.7, 1.0)]
    label = np.array([2, 0, 5], np.uint8)
    bright = np.array([0.1, 0.5, 0.9], np.float32)
    return Scan(np.array(points, np.float32), bright, SMALL, label=label)


@pytest.mark.parametrize("name", ["pair", "one", "bare", "empty"])
def test_a_page_opens_offline_without_an_error(
    driver: Any, folder: Path, name: str
) -> None:
    page = Page(driver, folder / f"{name}.html")
    assert page.errors() == []
    loaded = page.run(
        "return performance.getEntriesByType('resource').map((entry) => entry.name)"
    )
    assert [
        address for address in loaded if not address.startswith(("data:", "blob:"))
    ] == []
    drawn = [
        view
        for view in range(len(page.all(".view")))
        if "\n0 points" not in page.texts(".caption")[view]
    ]
    assert drawn
    if name != "empty":
        assert all(
            len(np.unique(page.pixels(view).reshape(-1, 3), axis=0)) > 20
            for view in drawn
        )


def test_a_real_scan_is_on_the_left_and_a_synthetic_one_on_the_right(
    page: Page,
) -> None:
    left, right = page.texts(".caption")
    assert left.startswith("real\nrandom-0 · small · 1,500 points · 1 of 3")
    assert right.startswith("synthetic\nrandom-3 · small · 1,500 points · 1 of 2")
    page.all(".strip")[0].find_elements("css selector", "button")[2].click()
    page.settle()
    assert [text.splitlines()[1][:8] for text in page.texts(".caption")] == [
        "random-2",
        "random-3",
    ]


@pytest.mark.parametrize("dragged", [0, 1])
def test_one_camera_turns_both_views(page: Page, dragged: int) -> None:
    before = [page.pixels(view) for view in (0, 1)]
    page.drag(dragged, 120, 40)
    after = [page.pixels(view) for view in (0, 1)]
    assert all(
        (a != b).any(-1).mean() > 0.01 for a, b in zip(before, after, strict=True)
    )
    camera = page.camera()
    page.press("r")
    for view in (0, 1):
        np.testing.assert_array_equal(page.pixels(view), before[view])
    page.drag(1 - dragged, 120, 40)
    assert page.camera() == camera
    for view in (0, 1):
        np.testing.assert_array_equal(
            page.pixels(view), after[view], "turned from the other view"
        )


def test_dragging_turns_and_moves_and_the_wheel_zooms(page: Page) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    start = page.camera()
    page.drag(0, 100, 0)
    turned = page.camera()
    assert turned["azimuth"] == pytest.approx(start["azimuth"] - 35, abs=2)
    assert turned["target"] == start["target"]
    page.drag(0, 100, 0, shift=True)
    moved = page.camera()
    assert moved["azimuth"] == turned["azimuth"]
    assert np.linalg.norm(np.subtract(moved["target"], start["target"])) > 2
    origin = ScrollOrigin.from_element(page.all(".view canvas")[1])
    ActionChains(page.driver).scroll_from_origin(origin, 0, 300).perform()
    page.settle()
    assert page.camera()["distance"] == pytest.approx(
        start["distance"] * np.exp(0.36), rel=0.01
    )
    assert page.texts(".picked") == ["", ""], "dragging picks nothing"


def visible(
    given: Scan, camera: dict[str, Any], size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels, depths and disc radii (in pixels) of the points in a view, by the package's own
    renderer."""
    orbit = Orbit(
        **{
            key: tuple(value) if key == "target" else value
            for key, value in camera.items()
        }
    )
    pixels, depth, per_metre = orbit.camera().look(given.points, size)
    gap = 0.015 + 0.003 * np.linalg.norm(given.points, axis=1)
    return pixels, depth, np.maximum(2 * gap * per_metre, 1.5) / 2


def nearest(
    given: Scan, camera: dict[str, Any], size: tuple[int, int], x: int, y: int
) -> int:
    """The point that a click at (x, y) means, by brute force; -1 for none."""
    pixels, depth, radius = visible(given, camera, size)
    away = np.where(depth > 0.2, np.linalg.norm(pixels - (x, y), axis=1), np.inf)
    covering = away <= radius
    if covering.any():
        covering &= depth <= 1.02 * depth[covering].min()
        away = np.where(covering, away, np.inf)
    return int(away.argmin()) if away.min() <= 8 else -1


def agrees(shown: dict[str, str], given: Scan, i: int) -> bool:
    """Whether the page's words are those of point ``i``."""
    if i < 0:
        return shown == {}
    assert given.label is not None
    label = "unlabelled" if given.label[i] == IGNORE else NAMES[given.label[i]]
    confidence = (
        "the scan has none"
        if given.confidence is None
        else f"{given.confidence[i]:.3f}"
    )

    def near(text: str, value: float, tolerance: float) -> bool:
        return bool(abs(float(text.split()[0]) - value) <= tolerance)

    return (
        near(shown["range"], np.linalg.norm(given.points[i]), 0.008)
        and shown["label"] == label
        and near(shown["reflectance"], given.reflectance[i], 0.008)
        and (
            shown["confidence"] == confidence
            or near(shown["confidence"], float(confidence), 0.008)
        )
        and np.allclose(
            [float(v) for v in shown["x, y, z"][:-2].split(", ")],
            given.points[i],
            atol=0.008,
        )
    )


@pytest.mark.parametrize("view", [0, 1])
def test_a_click_shows_the_values_of_the_point_under_the_cursor(
    page: Page, view: int
) -> None:
    given = (REALS[0], SYNTHETICS[0])[view]
    page.drag(0, 60, 30)  # a camera other than the first
    camera = page.camera()
    size = page.size(view)
    pixels, depth, _ = visible(given, camera, size)
    inside = ((pixels > 80) & (pixels < np.array(size) - 80)).all(1) & (depth > 1)
    gaps = np.linalg.norm(
        pixels[inside][:, None] - pixels[inside][None], axis=-1
    ) + 1e9 * np.eye(inside.sum())
    # nothing else is near these on the screen
    alone = np.flatnonzero(inside)[gaps.min(1) > 9]
    assert len(alone) >= 5
    for i in alone[:5]:
        x, y = np.rint(pixels[i]).astype(int)
        shown = page.click(view, int(x), int(y))
        assert agrees(shown, given, int(i)), (
            shown,
            i,
            given.points[i],
            np.linalg.norm(given.points[i]),
            pixels[i],
        )
        mark = page.run(
            "const m = state.views[arguments[0]].mark; return [parseFloat(m.style.left), "
            "parseFloat(m.style.top)]",
            view,
        )
        np.testing.assert_allclose(mark, pixels[i], atol=0.5)
    rng = np.random.default_rng(view)
    hits = 0
    for x, y in rng.integers((80, 80), np.array(size) - 80, (12, 2)).tolist():
        i = nearest(given, camera, size, x, y)
        shown = page.click(view, x, y)
        assert agrees(shown, given, i), (x, y, shown, i)
        hits += i >= 0
    assert hits >= 3
    assert page.texts(".picked")[1 - view] == "", "the other view keeps its own"


def test_the_front_point_is_picked_where_points_overlap(
    driver: Any, folder: Path
) -> None:
    page = Page(driver, folder / "overlap.html")
    width, height = page.size(0)
    shown = page.click(0, width // 2, height // 2)
    assert agrees(shown, behind_each_other(), 1), shown
    next(
        button for button in page.all("#classes button") if "car" in button.text
    ).click()  # hides the front point
    assert page.click(0, width // 2, height // 2)["label"] == "person"


KEYS = {"←": "ARROW_LEFT", "→": "ARROW_RIGHT", "Esc": "ESCAPE", "−": "SUBTRACT"}


def press_shown(page: Page, shown: str) -> None:
    """Press a key by its name in the help."""
    from selenium.webdriver import Keys

    name = shown.removeprefix("Shift ")
    key = "-" if name == "−" else getattr(Keys, KEYS[name]) if name in KEYS else name
    page.press(key, shift=shown.startswith("Shift "))


MOUSE = ("drag", "Shift drag", "wheel", "click")
CHANGES = {
    "1": "pressed",
    "2": "pressed",
    "3": "pressed",
    "4": "pressed",
    "5": "pressed",
    "←": "captions",
    "→": "captions",
    "Shift ←": "captions",
    "Shift →": "captions",
    "+": "size",
    "−": "size",
    "b": "pressed",
    "t": "pressed",
    "r": "camera",
    "Esc": "picked",
}
"""What every key of the page with two kinds of scans changes."""


def test_every_key_in_the_help_works(page: Page) -> None:
    listed = [key for key in page.texts("#keys kbd") if key not in MOUSE]
    assert sorted(listed) == sorted(CHANGES)
    width, height = page.size(0)
    pixels, _, _ = visible(REALS[0], page.camera(), (width, height))
    target = pixels[((pixels > 100) & (pixels < (width - 100, height - 100))).all(1)][0]
    for key in listed:
        page.drag(0, 30, 0)  # something to reset
        if key == "Esc":
            page.click(0, *np.rint(target).astype(int).tolist())
            page.press("r")
            assert page.click(0, *np.rint(target).astype(int).tolist())
        page.press("1" if key == "2" else "2")
        before = page.situation()
        press_shown(page, key)
        after = page.situation()
        assert before[CHANGES[key]] != after[CHANGES[key]], f"{key} changes nothing"
        if key in ("b", "t"):
            press_shown(page, key)
    for i, name in enumerate(page.texts("#colours button")):
        page.press(str(i + 1))
        assert [b.text for b in page.all('#colours button[aria-pressed="true"]')] == [
            name
        ]
        assert f"colour by {name}" in page.texts("#keys > span")[len(MOUSE) + i]


def test_every_key_that_works_is_in_the_help(page: Page) -> None:
    from selenium.webdriver import Keys

    listed = set(page.texts("#keys kbd"))
    others = [
        chr(code)
        for code in range(33, 127)
        if chr(code).replace("-", "−") not in listed
    ]
    named = (
        "ARROW_UP",
        "ARROW_DOWN",
        "HOME",
        "END",
        "PAGE_UP",
        "PAGE_DOWN",
        "SPACE",
        "ENTER",
        "BACKSPACE",
        "DELETE",
        "F2",
    )
    page.drag(0, 30, 0)
    before = page.situation()
    for key in others + [getattr(Keys, name) for name in named]:
        page.press(key)
        assert page.situation() == before, f"{key!r} is not in the help"


def test_a_page_with_one_scan_has_one_view_and_no_keys_for_others(
    driver: Any, folder: Path
) -> None:
    page = Page(driver, folder / "one.html")
    assert len(page.all(".view")) == 1
    assert page.size(0)[0] == page.run("return innerWidth")
    assert not {"←", "→", "Shift ←", "b"} & set(page.texts("#keys kbd"))
    before = page.situation()
    for key in ("←", "→", "b"):
        press_shown(page, key)
    assert page.situation() == before
    assert not page.all(".strip")[0].is_displayed()


def test_a_page_without_labels_says_so(driver: Any, folder: Path) -> None:
    page = Page(driver, folder / "bare.html")
    assert page.texts("#colours button") == ["height", "range", "reflectance"]
    assert len(page.all(".view")) == 2, "any two scans"
    width, height = page.size(0)
    pixels, _, _ = visible(REALS[0], page.camera(), (width, height))
    target = pixels[((pixels > 100) & (pixels < (width - 100, height - 100))).all(1)][0]
    shown = page.click(0, *np.rint(target).astype(int).tolist())
    assert (shown["label"], shown["confidence"]) == (
        "the scan has none",
        "the scan has none",
    )


def test_a_scan_without_the_chosen_quantity_is_grey_and_says_so(page: Page) -> None:
    page.press("5")
    left, right = page.texts(".caption")
    assert left.endswith("This scan has no confidence.")
    assert "no confidence" not in right
    strongest = [
        np.ptp(page.pixels(view).astype(int), axis=-1).max() for view in (0, 1)
    ]
    assert strongest[0] < 40 < strongest[1], "grey on the left, colours on the right"


def test_a_narrow_window_needs_no_scrolling_sideways(driver: Any, folder: Path) -> None:
    page = Page(driver, folder / "pair.html", (500, 800))
    assert page.run("return document.documentElement.scrollWidth <= innerWidth")
    boxes = [
        page.run("return arguments[0].getBoundingClientRect()", view)
        for view in page.all(".view")
    ]
    assert boxes[0]["bottom"] <= boxes[1]["top"], "the views are stacked"
    for button in page.all("#controls button"):
        box = page.run("return arguments[0].getBoundingClientRect()", button)
        assert 0 <= box["left"] < box["right"] <= 500
    page.drag(0, 40, 0)
    assert page.camera()["azimuth"] != Orbit().azimuth


def test_pictures_take_the_place_of_the_viewer_without_webgl(folder: Path) -> None:
    for driver in running("--disable-3d-apis"):
        page = Page(driver, folder / "pair.html")
        assert "does not support WebGL 2" in page.texts("#warning")[0]
        assert [still.is_displayed() for still in page.all(".still")] == [True, True]
        assert not page.all("#keys")[0].is_displayed()
        assert [entry for entry in page.errors() if "WebGL" not in entry] == []
