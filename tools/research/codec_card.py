"""Measure what an autoencoder preserves of a scan, by class: the figures of
docs/research/autoencoder.md.

    python tools/research/codec_card.py NAME=MODEL ... [--count 24]

    python tools/research/codec_card.py "as it ships=town" "mine=runs/town_codec/town_codec.safetensors"

The scans are from a town that no model was trained on, each on another street. They are encoded,
and decoded to the mode of the predicted distributions. A flow on these latents cannot be more
accurate than this.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from model_card import open_codec, town
from tqdm import tqdm

from lidar_synth.datasets.classes import IGNORE, TRAIN_ID
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import RangeImage
from lidar_synth.lab.train import reconstruct

SEED = 7
"""Seed of the town."""
CLASSES = ("road", "building", "fence", "vegetation", "car", "pole")


def there_and_back(model: str, images: list[RangeImage]) -> list[RangeImage]:
    """Range images, encoded and decoded by the autoencoder of a checkpoint."""
    codec = open_codec(model)
    made = []
    for image in tqdm(images, desc=Path(model).stem, unit="scan"):
        made += reconstruct(codec, codec.tensors.from_images([image]), image.sensor)
    return made


def row(name: str, real: list[RangeImage], made: list[RangeImage]) -> str:
    """A line of the table, in per cent."""
    a, b = (np.stack([image.range for image in images]) for images in (real, made))
    labels, decoded = (
        np.stack([image.channels["label"] for image in images])
        for images in (real, made)
    )
    both = (a > 0) & (b > 0)
    off = np.abs(np.divide(b, a, where=both, out=np.ones_like(a)) - 1)
    right = [
        ((a > 0) == (b > 0)).mean(),
        (labels == decoded)[both & (labels != IGNORE)].mean(),
    ]
    medians = [np.median(off[both & (labels == TRAIN_ID[one])]) for one in CLASSES]
    return f"| {escape_markdown(name)} | {' | '.join(f'{100 * v:.1f}' for v in (*right, *medians))} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="+", metavar="NAME=MODEL")
    parser.add_argument("--count", type=int, default=24, help="scans")
    given = parser.parse_args()

    images = [
        project(scan, channels=["reflectance", "label"])
        for scan in town(SEED, given.count)
    ]
    lines = []
    for text in given.models:
        name, model = text.split("=", 1)
        with torch.inference_mode():
            lines.append(row(name, images, there_and_back(model, images)))
    print(
        f"{given.count} scans of town {SEED}; per cent: cells, labels; medians of |range / true "
        "range - 1|\n"
    )
    columns = ("returns right", "labels right", *CLASSES)
    print(f"| autoencoder | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
