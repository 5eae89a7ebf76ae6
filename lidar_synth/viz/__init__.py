"""Visualisation of scans: pictures, sheets, an HTML page with a viewer, and a window.

``write_view`` writes scans to a picture or page; the other functions are its parts. Only ``show``
needs a screen and OpenGL; nothing needs a network connection.
"""

from collections.abc import Sequence
from pathlib import Path

from lidar_synth.errors import ConfigError
from lidar_synth.files.disk import write_file
from lidar_synth.geometry import RangeImage, Scan
from lidar_synth.viz.images import picture
from lidar_synth.viz.page import html_page
from lidar_synth.viz.render import Camera, Orbit, bird, render
from lidar_synth.viz.rerun import to_rerun
from lidar_synth.viz.scales import Scale, make_scales
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
    "make_scales",
    "picture",
    "render",
    "sheet",
    "show",
    "to_rerun",
    "view_suffix",
    "write_view",
]


def view_suffix(path: Path) -> str:
    """The suffix of a path in small letters, if ``write_view`` can write such a file.

    Raises:
        ConfigError: on any other suffix than .png and .html.
    """
    suffix = path.suffix.lower()
    if suffix not in (".png", ".html"):
        raise ConfigError(
            f"cannot write a view to {path}", "a file that ends in .png or .html"
        )
    return suffix


def write_view(
    path: str | Path,
    given: Sequence[Scan | RangeImage],
    *,
    title: str = "LiDAR scans",
    notes: str = "",
) -> None:
    """Write a picture or a page of scans to a file.

    Args:
        path: ``.png`` for a sheet with all views of one scan, or with several scans side by side;
            ``.html`` for a page with an interactive viewer.
        given: scans or range images, at least one.
        title: the heading of a page, or of a sheet of several scans.
        notes: text for the page; an empty line starts a paragraph.

    Raises:
        ConfigError: on another suffix, or without scans.
        DataError: on points that are NaN or infinite, another reflectance than 0 to 1, or labels
            that are not train ids.
        FileError: if the file cannot be written.

    Example:
        >>> from lidar_synth import Town
        >>> from lidar_synth.viz import write_view
        >>> write_view("scan.html", [Town(seed=0, scans=1)[0]], title="One scan")
        >>> open("scan.html").read(15)
        '<!doctype html>'
    """
    path = Path(path)
    if view_suffix(path) == ".html":
        write_file(path, html_page(given, title=title, notes=notes).encode())
        return
    figure = sheet(given[0]) if len(given) == 1 else contact_sheet(given, title=title)
    write_file(path, lambda file: figure.savefig(file, format="png"))
