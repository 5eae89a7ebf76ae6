"""One HTML file that shows scans: nothing else is needed, neither a network nor a server.

The viewer (``draw.js``, ``page.js``) is WebGL 2 without a library. Points travel quantised in 8 bytes (``POINT``):
a scan of 120,000 is 1.3 MB of text, and keeps its positions to 1.3 mm where the farthest is 80 m away.
"""

import base64
import html
import io
import json
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import ConfigError
from lidar_synth.files.parsing import read_picture
from lidar_synth.geometry.scan import RangeImage, Scan
from lidar_synth.viz.colour import DOMAINS, EMPTY, Rgb, Scale, known, scales
from lidar_synth.viz.images import View, picture, views
from lidar_synth.viz.render import Orbit, box_segments, render, ring_segments

POINT = np.dtype([("cell", "<i2", 3), ("reflectance", "u1"), ("label", "u1")])
"""A packed point: position = cell * metres per step; reflectance * 255; train id, 255 = ignore."""


def pack(scan: Scan) -> tuple[NDArray[Any], float]:
    """(N,) points as ``POINT``, and the metres that one step of ``cell`` is."""
    farthest = float(np.abs(scan.points).max(initial=0.0))
    metres = max(farthest, 1.0) / 32767
    packed = np.empty(len(scan), POINT)
    packed["cell"] = np.rint(scan.points / metres)
    packed["reflectance"] = np.rint(np.clip(scan.reflectance, 0, 1) * 255)
    packed["label"] = IGNORE if scan.label is None else scan.label
    return packed, metres


def html_page(given: Sequence[Scan | RangeImage], *, title: str = "LiDAR scans", notes: str = "") -> str:
    """A page with an interactive viewer and the range images of every scan.

    Args:
        given: scans, or range images, whose points are then shown.
        title: the heading.
        notes: text below it; an empty line starts a paragraph.

    Raises:
        ConfigError: when nothing is given.
    """
    if not given:
        raise ConfigError("a page of no scans", "at least one")
    all_views = views(given)
    colours = scales([view.scan for view in all_views])
    content = {
        "by": "label" if any(view.scan.label is not None for view in all_views) else "height",
        "camera": Orbit()._asdict(),
        "empty": EMPTY.tolist(),
        "domains": list(DOMAINS),
        "classes": [*NAMES, "unlabelled"],
        "scales": {name: _scale(scale, row) for row, (name, scale) in enumerate(colours.items())},
        "table": _text(np.concatenate([scale.table for scale in colours.values()]).tobytes()),
        "scans": [
            _scan(view, colours)
            for view in tqdm(all_views, "drawing", unit="scan", leave=False, disable=len(given) < 4)
        ],
    }
    paragraphs = (f"<p>{html.escape(part.strip())}</p>" for part in notes.split("\n\n") if part.strip())
    parts = {
        "title": html.escape(title),
        "notes": "".join(paragraphs),
        # "<" would let a name in the data end its element.
        "data": json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "draw": _resource("draw.js"),
        "script": _resource("page.js"),
    }
    return re.sub("@(title|notes|data|draw|script)@", lambda mark: parts[mark[1]], _resource("page.html"))


def _resource(name: str) -> str:
    return files("lidar_synth.viz").joinpath(name).read_text(encoding="utf-8")


def _scale(scale: Scale, row: int) -> dict[str, Any]:
    return {"title": scale.title, "row": row, "low": scale.low, "high": scale.high, "gamma": scale.gamma}


def _scan(view: View, colours: dict[str, Scale]) -> dict[str, Any]:
    scan = view.scan
    packed, metres = pack(scan)
    by = "label" if scan.label is not None else "height"
    pictures = [
        {"title": colours[name].title, "uri": _uri(picture(view.image, name, colours[name])), "cells": True}
        for name in view.channels
    ]
    if scan.image_path is not None and scan.image_path.is_file():
        pictures.append({"title": "camera", "uri": _photo(scan.image_path), "cells": False})
    return {
        "id": scan.id or "scan",
        "sensor": scan.sensor.name,
        "domain": scan.domain,
        "count": len(scan),
        "metres": metres,
        "points": _text(packed.tobytes()),
        "colours": list(known(scan)),
        "classes": view.classes.tolist(),
        "boxes": _text(box_segments(scan.boxes).tobytes()) if scan.boxes is not None else "",
        "rings": _text(ring_segments(scan).tobytes()),
        "still": _uri(render(scan, by, size=(960, 540), scale=colours[by]), "JPEG"),
        "pictures": pictures,
    }


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _uri(pixels: Rgb, kind: str = "PNG") -> str:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, optimize=True)
    return f"data:image/{kind.lower()};base64,{_text(file.getvalue())}"


def _photo(path: Path) -> str:
    small = read_picture(path).convert("RGB")
    small.thumbnail((1200, 600))
    return _uri(np.asarray(small), "JPEG")
