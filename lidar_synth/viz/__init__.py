"""Seeing scans: pictures, sheets, a page for the browser, a window.

``write_view`` makes a file of any scans; the rest is what it is made of. Nothing here needs a graphics card, a
screen or a network, but ``show``.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from lidar_synth.errors import ConfigError
from lidar_synth.files.disk import write_file
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.viz.colour import Scale, scales
from lidar_synth.viz.images import picture
from lidar_synth.viz.page import html_page
from lidar_synth.viz.render import Camera, Orbit, bird, render
from lidar_synth.viz.sheet import contact_sheet, histograms, sheet
from lidar_synth.viz.window import show

__all__ = [
    "Camera",
    "Orbit",
    "Scale",
    "bird",
    "contact_sheet",
    "histograms",
    "html_page",
    "picture",
    "render",
    "scales",
    "sheet",
    "show",
    "view_suffix",
    "write_view",
]


def _write_png(path: Path, given: Sequence[Scan | RangeImage], title: str, notes: str) -> None:
    figure = sheet(given[0]) if len(given) == 1 else contact_sheet(given, title=title)
    write_file(path, lambda file: figure.savefig(file, format="png"))


def _write_html(path: Path, given: Sequence[Scan | RangeImage], title: str, notes: str) -> None:
    write_file(path, html_page(given, title=title, notes=notes).encode())


_WRITERS: dict[str, Callable[[Path, Sequence[Scan | RangeImage], str, str], None]] = {
    ".png": _write_png,
    ".html": _write_html,
}


def view_suffix(path: Path) -> str:
    """The suffix of a file that ``write_view`` can write.

    Raises:
        ConfigError: on another one.
    """
    if path.suffix not in _WRITERS:
        raise ConfigError(f"a view in {path}", f"a file that ends in {' or '.join(_WRITERS)}")
    return path.suffix


def write_view(
    path: str | Path, given: Sequence[Scan | RangeImage], *, title: str = "LiDAR scans", notes: str = ""
) -> None:
    """Writes what scans look like to a file.

    Args:
        path: ``.png`` for a sheet with all views of one scan, or with many scans side by side; ``.html`` for
            a page with an interactive viewer.
        given: scans or range images, at least one.
        title: the heading of a page or of a sheet with many.
        notes: text for the page; an empty line starts a paragraph.

    Raises:
        ConfigError: on another suffix, or when nothing is given.
        FileError: where the file cannot be written.
    """
    path = Path(path)
    if not given:
        raise ConfigError(f"a view of no scans in {path}", "at least one scan")
    _WRITERS[view_suffix(path)](path, given, title, notes)
