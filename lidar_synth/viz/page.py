"""A self-contained HTML page that shows scans, two of them side by side; it needs no network and no
server.

The viewer (``camera.js``, ``draw.js``, ``page.js``) uses WebGL 2 without a library. The points of a
scan are quantised and compressed (``pack``): the error of a coordinate is at most 1.3 mm if the
farthest point is at 80 m, and a scan of 57,000 points becomes 0.3 MB of text.
"""

import base64
import html
import io
import json
import re
import zlib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.files.parsing import read_rgb
from lidar_synth.geometry import RangeImage, Scan
from lidar_synth.viz.images import View, picture, views
from lidar_synth.viz.render import Orbit, box_segments, render, ring_segments
from lidar_synth.viz.scales import DOMAINS, EMPTY, Rgb, Scale, available, make_scales

SCRIPTS = ("camera.js", "draw.js", "page.js")
"""The scripts of the page, in this order."""


def pack(scan: Scan) -> tuple[bytes, float]:
    """Compress the points of a scan by zlib.

    Returns:
        The compressed bytes of these arrays, one after the other, and the length of a quantisation
        step in metres: x, y and z, (N,) int16 each, in steps, as differences from the previous
        point (modulo 2**16); reflectance * 255, (N,) uint8; label, (N,) uint8 train ids, 255 =
        ignore; and, if the scan has it, confidence * 255, (N,) uint8. Coordinates end at four
        times the sensor's range, so that one far point does not coarsen the others.
    """
    farthest = float(np.abs(scan.points).max(initial=1.0))
    metres = min(farthest, 4 * scan.sensor.range_max) / 32767
    places = np.rint(scan.points / metres).clip(-32767, 32767).astype("<i2")
    columns = [np.diff(places[:, axis], prepend=np.int16(0)) for axis in range(3)]
    columns += [
        _byte(scan.reflectance),
        np.full(len(scan), IGNORE, np.uint8)
        if scan.label is None
        else scan.label.astype(np.uint8),
    ]
    columns += [] if scan.confidence is None else [_byte(scan.confidence)]
    return zlib.compress(b"".join(column.tobytes() for column in columns), 9), metres


def _byte(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Values in [0, 1] as 0..255."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def html_page(
    given: Sequence[Scan | RangeImage],
    *,
    title: str = "LiDAR scans",
    notes: str = "",
    domains: Sequence[str] = tuple(DOMAINS),
    panels: Sequence[str] = (),
) -> str:
    """The HTML text of a page with an interactive viewer and the range images of every scan.

    Where there are real and synthetic scans, the viewer shows a real one on the left and a
    synthetic one on the right; otherwise any two of them. Both are seen through one camera.

    Args:
        given: scans, or range images, which are unprojected to points; at least one.
        title: the heading.
        notes: text below the heading; an empty line starts a paragraph.
        domains: what the page calls real and synthetic scans.
        panels: HTML below the viewer, inserted as it is.

    Raises:
        ConfigError, DataError: as ``images.views``.
    """
    all_views = views(given)
    colours = make_scales([view.scan for view in all_views])
    content = {
        "by": "label"
        if any(view.scan.label is not None for view in all_views)
        else "height",
        "camera": Orbit()._asdict(),
        "empty": EMPTY.tolist(),
        "domains": list(domains),
        "classes": [*NAMES, "unlabelled"],
        "scales": {
            name: {
                "title": scale.title,
                "row": row,
                "low": scale.low,
                "high": scale.high,
                "gamma": scale.gamma,
            }
            for row, (name, scale) in enumerate(colours.items())
        },
        "table": _base64(
            np.concatenate([scale.table for scale in colours.values()]).tobytes()
        ),
        "scans": [
            _scan_data(view, colours)
            for view in tqdm(
                all_views, "drawing", unit="scan", leave=False, disable=len(given) < 4
            )
        ],
    }
    paragraphs = (
        f"<p>{html.escape(part.strip())}</p>"
        for part in notes.split("\n\n")
        if part.strip()
    )
    parts = {
        "title": html.escape(title),
        "notes": "".join(paragraphs),
        # An unescaped "<" in a name could close the script element that contains the data.
        "data": json.dumps(content, separators=(",", ":"), allow_nan=False).replace(
            "<", "\\u003c"
        ),
        "panels": "".join(panels),
        "script": "\n".join(_resource(name) for name in SCRIPTS),
    }
    return re.sub(
        "@(title|notes|data|panels|script)@",
        lambda mark: parts[mark[1]],
        _resource("page.html"),
    )


def _resource(name: str) -> str:
    return files("lidar_synth.viz").joinpath(name).read_text(encoding="utf-8")


def _scan_data(view: View, colours: dict[str, Scale]) -> dict[str, Any]:
    scan = view.scan
    packed, metres = pack(scan)
    by = "label" if scan.label is not None else "height"
    pictures = [
        {
            "title": colours[name].title,
            "uri": _data_uri(picture(view.image, name, colours[name])),
            "cells": True,
        }
        for name in view.channels
    ]
    if scan.image_path is not None and scan.image_path.is_file():
        pictures.append(
            {"title": "camera", "uri": _camera_image(scan.image_path), "cells": False}
        )
    return {
        "id": scan.id or "scan",
        "sensor": scan.sensor.name,
        "domain": scan.domain,
        "count": len(scan),
        "metres": metres,
        "points": _base64(packed),
        "colours": list(available(scan)),
        "classes": view.classes.tolist(),
        "boxes": _base64(box_segments(scan.boxes).tobytes())
        if scan.boxes is not None
        else "",
        "rings": _base64(ring_segments(scan).tobytes()),
        "still": _data_uri(
            render(scan, by, size=(640, 360), scale=colours[by]), "JPEG"
        ),
        "pictures": pictures,
    }


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _data_uri(pixels: Rgb, kind: str = "PNG") -> str:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, optimize=True)
    return f"data:image/{kind.lower()};base64,{_base64(file.getvalue())}"


def _camera_image(path: Path) -> str:
    small = read_rgb(path)
    small.thumbnail((1200, 600))
    return _data_uri(np.asarray(small), "JPEG")
