"""The panels of the page: the samples of a mixture, the comparison of trainings, the table of
classes."""

import re
import sys

import numpy as np
import pytest
from project import ROOT

from lidar_synth.datasets.classes import NAMES, TRAIN_ID
from lidar_synth.viz.colour import DOMAINS

sys.path.append(str(ROOT / "tools"))
from panels import (
    classes_panel,
    mixture_panel,
    scores_panel,
    verdict,
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


def test_the_score_panel_shows_every_seed_mean_and_spread() -> None:
    panel = scores_panel({"a": [0.10, 0.14], "b & c": [0.2]}, ["short <training>"])
    rows = panel.split('<div class="score">')[1:3]
    top = 0.25  # 20 % and some room, in steps of 5 %
    for row, scores, colour in zip(
        rows, ([0.10, 0.14], [0.2]), (REAL, SYNTHETIC), strict=True
    ):
        found = re.findall(
            r'class="seed" style="left:([\d.]+)%;background:(rgb\([\d,]+\))"', row
        )
        assert [float(left) for left, _ in found] == pytest.approx(
            [100 * s / top for s in scores], abs=0.01
        )
        assert {each for _, each in found} == {colour}
        [mean] = re.findall(r'class="mean" style="left:([\d.]+)%', row)
        assert float(mean) == pytest.approx(100 * np.mean(scores) / top, abs=0.01)
    assert "12.0 ± 2.8 %" in rows[0]
    assert "20.0 %" in rows[1]
    assert "b &amp; c" in rows[1]
    assert "25 %" in panel
    assert "short &lt;training&gt;" in panel


@pytest.mark.parametrize(
    ("without", "with_synthetic", "said"),
    [
        (
            [0.1, 0.2],
            [0.12, 0.21],
            r"\+1\.5 percentage points \(by seed: \+2\.0, \+1\.0\)\. .* helped with each of the 2",
        ),
        ([0.1, 0.2], [0.08, 0.19], r"-1\.5 .*did not help with any of the 2 seeds"),
        (
            [0.1, 0.2, 0.2],
            [0.15, 0.19, 0.19],
            r"helped with 1 of 3 seeds: this comparison shows no clear difference",
        ),
        ([0.1], [0.3], r"\+20\.0 percentage points\. One seed cannot tell"),
        ([0.1, 0.1], [0.1, 0.1], r"did not help with any"),
    ],
)
def test_the_verdict_says_what_the_seeds_show(
    without: list[float], with_synthetic: list[float], said: str
) -> None:
    assert re.search(said, verdict(without, with_synthetic))


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
