"""A small sensor and functions that read pages, for the tests of visualisation."""

import base64
import io
import json
import re
from typing import Any

import numpy as np
from PIL import Image

from lidar_synth.datasets.classes import TRAIN_ID
from lidar_synth.geometry.sensor import Sensor

SMALL = Sensor(
    "small",
    columns=64,
    rows=16,
    fov_up=10.0,
    fov_down=-30.0,
    range_min=1.0,
    range_max=80.0,
)


CAR = TRAIN_ID["car"]
ROAD = TRAIN_ID["road"]


def page_data(page: str) -> dict[str, Any]:
    match = re.search(
        r'<script type="application/json" id="data">(.*?)</script>', page, re.S
    )
    assert match
    data: dict[str, Any] = json.loads(match[1])
    return data


def pixels(uri: str) -> np.ndarray:
    head, _, content = uri.partition(",")
    assert re.fullmatch(r"data:image/(png|jpeg);base64", head)
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(content))).convert("RGB"))
