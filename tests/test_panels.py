"""The panels of the page: the samples of a mixture, the table of classes."""

import re
import sys

import numpy as np
from project import ROOT

from lidar_synth.datasets.classes import NAMES, TRAIN_ID
from lidar_synth.viz.scales import DOMAINS

sys.path.append(str(ROOT / "tools"))
from panels import (
    classes_panel,
    mixture_panel,
)  # a script's own module

REAL, SYNTHETIC = (f"rgb({','.join(map(str, colour))})" for colour in DOMAINS.values())


def test_the_mixture_panel_shows_every_sample_in_order() -> None:
    panel = mixture_panel([0, 1, 0, 0, 1], ("town", "<made>"))
    squares = re.findall(
        r'background:(rgb\([\d,]+\))" title="sample (\d): ([^"]+)"', panel
    )
    assert squares == [
        (REAL, "0", "town"),
        (SYNTHETIC, "1", "&lt;made&gt;"),
        (REAL, "2", "town"),
        (REAL, "3", "town"),
        (SYNTHETIC, "4", "&lt;made&gt;"),
    ]
    text = re.sub("<[^>]+>", "", panel)
    assert "5 samples in training order: 3 town, 2 &lt;made&gt; (40 %)." in text


def test_the_class_table_is_ordered_by_its_first_column() -> None:
    share = np.zeros(len(NAMES))
    iou = np.full(len(NAMES), np.nan)
    share[TRAIN_ID["road"]] = 0.4
    share[TRAIN_ID["car"]] = 0.5
    share[TRAIN_ID["pole"]] = 0.0001
    iou[TRAIN_ID["road"]] = 0.9
    iou[TRAIN_ID["person"]] = 0.01
    rows = re.findall(
        r"<tr><td>(.*?)</tr>", classes_panel({"share <1>": share, "IoU": iou})
    )
    cells = [re.sub("<[^>]+>", " ", row).split() for row in rows]
    assert cells == [
        ["car", "50.0", "–"],
        ["road", "40.0", "90.0"],
        ["pole", "&lt;0.1", "–"],
        ["person", "0.0", "1.0"],
    ]
