"""The command lidar-synth view, and the window."""

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from click.testing import Result
from conftest import random_scan
from pictures import SMALL, page_data, pixels
from PIL import Image
from typer.testing import CliRunner

from lidar_synth.cli.view import view as command
from lidar_synth.errors import ConfigError, LibraryError
from lidar_synth.geometry.scan import Boxes
from lidar_synth.geometry.sensor import load_sensor
from lidar_synth.viz import (
    make_scales,
    window,
)
from lidar_synth.viz.render import box_segments

View = Callable[..., Result]


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> View:
    """Runs ``lidar-synth view`` on a folder of three scans, from an empty working directory and
    without a screen."""
    data = tmp_path / "data"
    data.mkdir()
    for i in range(3):
        scan = random_scan(load_sensor("town"), 400, seed=i)
        np.column_stack([scan.points, scan.reflectance]).astype("<f4").tofile(
            data / f"{i:06}.bin"
        )
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(window, "has_screen", lambda: False)
    app = typer.Typer()
    app.command()(command)
    return lambda *args: CliRunner().invoke(
        app, [str(data), *args], catch_exceptions=True
    )


def test_view_writes_a_page_where_there_is_no_screen(view: View) -> None:
    result = view("--index", "1")
    assert result.exit_code == 0, result.output
    [page] = Path().iterdir()
    assert page.name == "data-1.html"
    assert result.stdout.startswith("data-1.html: 1 of the scans in")
    [scan] = page_data(page.read_text(encoding="utf-8"))["scans"]
    assert "000001" in scan["id"]
    assert scan["count"] == 400


@pytest.mark.parametrize(
    ("cut", "count", "ids"),
    [("000001", 3, ["000000", "000002"]), ("000000", 1, ["000001"])],
)
def test_view_shows_the_next_scans_if_it_skips_one(
    view: View, tmp_path: Path, cut: str, count: int, ids: list[str]
) -> None:
    (tmp_path / "data" / f"{cut}.bin").write_bytes(b"cut")
    with pytest.warns(UserWarning, match=f"skipped scan {cut}"):
        view("--count", count, "--on-bad", "skip", "--out", "out.html")
    page = page_data(Path("out.html").read_text(encoding="utf-8"))
    assert [scan["id"] for scan in page["scans"]] == ids


@pytest.mark.slow
@pytest.mark.parametrize(
    ("args", "ids"),
    [
        (["--index", "-1"], ["000002"]),
        (["--index", "-3", "--count", "2"], ["000000", "000001"]),
        (["--count", "9"], ["000000", "000001", "000002"]),
    ],
)
def test_view_shows_the_selected_scans(
    view: View, args: list[str], ids: list[str]
) -> None:
    assert view(*args, "--out", "out.html").exit_code == 0
    shown = page_data(Path("out.html").read_text(encoding="utf-8"))["scans"]
    assert [scan["id"][-6:] for scan in shown] == ids


@pytest.mark.slow
def test_view_accepts_a_sensor_and_writes_a_sheet(view: View) -> None:
    assert view("--sensor", "os1_128", "--out", "one.html").exit_code == 0
    [scan] = page_data(Path("one.html").read_text(encoding="utf-8"))["scans"]
    assert scan["sensor"] == "os1_128"
    assert pixels(scan["pictures"][0]["uri"]).shape == (128, 1024, 3)
    assert view("--count", "3", "--out", "all.png").exit_code == 0
    assert Image.open("all.png").size[0] == 920


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--index", "3"], r"--index 3: .* holds 3 scans; expected 0 \.\. 2"),
        (["--index", "-4"], r"--index -4: .* holds 3 scans"),
        (
            ["--out", "scan.jpg"],
            r"scan\.jpg; expected a file that ends in \.png or \.html",
        ),
        (["--sensor", "velodyne"], r"sensor 'velodyne'; expected one of"),
    ],
)
def test_the_error_of_a_wrong_call_names_the_right_one(
    view: View, args: list[str], message: str
) -> None:
    result = view(*args)
    assert isinstance(result.exception, ConfigError)
    assert re.search(message, str(result.exception))
    assert not list(Path().iterdir())


@pytest.mark.skipif(
    sys.platform in ("win32", "darwin"), reason="a screen is always there"
)
def test_there_is_no_window_if_no_display_server_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A DISPLAY without a server is not a screen: open3d would wait forever."""
    monkeypatch.setenv("DISPLAY", ":4242")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    assert not window.has_screen()
    assert not window.show([random_scan(SMALL)])


def test_there_is_no_window_without_open3d(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "has_screen", lambda: True)
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert not window.show([random_scan(SMALL)])


def test_the_window_draws_points_and_boxes() -> None:
    try:
        window.import_open3d()
    except LibraryError as error:
        pytest.skip(str(error))
    boxes = Boxes(np.array([(5, 1, -1, 4, 2, 1.5, 0.3)], np.float32), ("Car",))
    scan = replace(random_scan(SMALL), boxes=boxes)
    cloud, lines = window.geometries(scan, make_scales([scan]))
    np.testing.assert_array_equal(
        np.asarray(cloud.points).astype(np.float32), scan.points
    )
    np.testing.assert_allclose(
        np.asarray(cloud.colors) * 255,
        make_scales([scan])["label"](scan.label),
        atol=1e-4,
    )
    drawn = np.asarray(lines.points)[np.asarray(lines.lines)]
    np.testing.assert_allclose(drawn, box_segments(boxes), atol=1e-6)
    assert len(window.geometries(replace(scan, boxes=None), make_scales([scan]))) == 1
