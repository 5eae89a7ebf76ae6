"""Scans as a network that learnt from real streets sees them: range, reflectance, labels, and the
classes it predicts.

    python tools/judge_pictures.py OUT.png --judge FOLDER [--scans PATH] [--index 7 107 207]
    [--width 2048]

FOLDER is an archive of lidar-bonnetal. Without PATH the scans are those of the town with seed 7.
Each scan is four strips of its front half; range, reflectance and classes have the colours of
``lidar-synth view``.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from lidar_synth import Scan, open_scans
from lidar_synth.datasets.classes import IGNORE
from lidar_synth.geometry.projection import project
from lidar_synth.lab.evaluate.street_judge import StreetJudge, load_archive
from lidar_synth.lab.town import Town
from lidar_synth.viz.images import picture


def strips(scan: Scan, judge: StreetJudge) -> NDArray[np.uint8]:
    """(4 H, W / 2, 3) the front half of a scan: range, reflectance, labels, predicted classes."""
    image = project(scan, judge.segmenter.sensor, ("reflectance", "label"))
    predicted = judge.predict(judge.image(scan)[0])
    found = replace(
        image, channels={"label": np.where(image.mask, predicted, IGNORE).astype(np.uint8)}
    )
    parts = [picture(image, channel) for channel in ("range", "reflectance", "label")] + [
        picture(found, "label")
    ]
    quarter = judge.segmenter.sensor.columns // 4
    return np.concatenate([part[:, quarter:-quarter] for part in parts])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="PNG file to write")
    parser.add_argument("--judge", type=Path, required=True, help="archive of lidar-bonnetal")
    parser.add_argument("--scans", type=Path, help="labelled scans in place of the town's")
    parser.add_argument("--index", type=int, nargs="+", default=[7, 107, 207])
    parser.add_argument("--width", type=int, default=2048, help="of the judge's grid")
    given = parser.parse_args()
    judge = load_archive(given.judge, given.width)
    source = open_scans(given.scans) if given.scans else Town(7, scans=max(given.index) + 1)
    rows = [strips(source[index], judge) for index in tqdm(given.index, unit="scan")]
    gap = np.full((6, rows[0].shape[1], 3), 255, np.uint8)
    pixels = np.concatenate([part for row in rows for part in (row, gap)][:-1])
    image = Image.fromarray(pixels).resize(
        (pixels.shape[1], 2 * len(pixels)), Image.Resampling.NEAREST
    )
    image.quantize(128, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        given.out, optimize=True
    )


if __name__ == "__main__":
    main()
