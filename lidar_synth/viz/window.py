"""An interactive window with open3d, on machines with a screen."""

import ctypes
import os
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np

from lidar_synth.errors import LibraryError
from lidar_synth.geometry import Scan
from lidar_synth.viz.render import Orbit, box_segments
from lidar_synth.viz.scales import EMPTY, Scale, make_scales, point_values

# GLFW's key codes
_LEFT = 263
_RIGHT = 262


def import_open3d() -> ModuleType:
    """Import open3d.

    Raises:
        LibraryError: if open3d or a system library that it needs is missing.
    """
    try:
        import open3d  # type: ignore[import-untyped,unused-ignore]
    except (ImportError, OSError) as error:
        raise LibraryError(
            f"open3d cannot be imported ({error})",
            "open3d and its system libraries, for the 3-D window",
            "Type: apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1 libudev1",
        ) from error
    return open3d  # type: ignore[no-any-return,unused-ignore]


def has_screen() -> bool:
    """Whether a window can be shown: on Unix, whether a display server answers.

    A set DISPLAY is not enough: if no server answers, open3d renders off screen and waits forever.
    """
    if sys.platform in ("win32", "darwin"):
        return True
    if _can_connect("libX11.so.6", "XOpenDisplay", "XCloseDisplay"):
        return True
    # Without it, libwayland prints an error to the terminal.
    wayland = "XDG_RUNTIME_DIR" in os.environ
    return wayland and _can_connect(
        "libwayland-client.so.0", "wl_display_connect", "wl_display_disconnect"
    )


def _can_connect(library: str, connect: str, disconnect: str) -> bool:
    """Whether a client library can connect to its display server."""
    try:
        client = ctypes.CDLL(library)
    except OSError:
        return False
    client[connect].restype = ctypes.c_void_p
    display = client[connect](None)
    if display:
        client[disconnect](ctypes.c_void_p(display))
    return bool(display)


def show(scans: Sequence[Scan], title: str = "lidar-synth") -> bool:
    """Show scans in a window until it is closed; the left and right arrow keys switch between
    scans.

    Args:
        scans: at least one scan.
        title: the title of the window.

    Returns:
        Whether a window was shown. False without a screen, without open3d or one of its system
        libraries, or without OpenGL.
    """
    if not has_screen():
        return False
    try:
        open3d = import_open3d()
    except LibraryError:
        return False
    window = open3d.visualization.VisualizerWithKeyCallback()
    if not window.create_window(window_name=title, width=1280, height=720):
        return False
    colours = make_scales(scans)
    shown = 0

    def turn(step: int) -> Any:
        def change(window: Any) -> bool:
            nonlocal shown
            shown = (shown + step) % len(scans)
            window.clear_geometries()
            for geometry in geometries(scans[shown], colours):
                window.add_geometry(geometry, reset_bounding_box=False)
            return False

        return change

    for geometry in geometries(scans[0], colours):
        window.add_geometry(geometry)
    window.register_key_callback(_LEFT, turn(-1))
    window.register_key_callback(_RIGHT, turn(1))
    options = window.get_render_option()
    view = window.get_view_control()
    options.background_color = EMPTY / 255
    options.point_size = 2.0
    camera = Orbit().camera()
    view.set_lookat(camera.target)
    view.set_front(np.subtract(camera.eye, camera.target))
    view.set_up(camera.up)
    view.set_zoom(0.25)
    window.run()
    window.destroy_window()
    return True


def geometries(scan: Scan, colours: dict[str, Scale]) -> list[Any]:
    """The open3d geometries of a scan: its points, coloured by label (or by height without labels),
    and its boxes.

    Args:
        scan: N points.
        colours: the colour scales, from ``make_scales``.

    Raises:
        LibraryError: if open3d is missing.
    """
    open3d = import_open3d()
    vectors = open3d.utility.Vector3dVector
    by = "label" if scan.label is not None else "height"
    cloud = open3d.geometry.PointCloud(vectors(scan.points.astype(np.float64)))
    cloud.colors = vectors(colours[by](point_values(scan, by)) / 255)
    if scan.boxes is None or not len(scan.boxes):
        return [cloud]
    ends = box_segments(scan.boxes).reshape(-1, 3).astype(np.float64)
    pairs = open3d.utility.Vector2iVector(
        np.arange(len(ends), dtype=np.int32).reshape(-1, 2)
    )
    lines = open3d.geometry.LineSet(points=vectors(ends), lines=pairs)
    lines.paint_uniform_color((1.0, 1.0, 1.0))
    return [cloud, lines]
