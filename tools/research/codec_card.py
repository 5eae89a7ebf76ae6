"""Measure what an autoencoder preserves of a scan, by class: the figures of
docs/research/training.md.

    python tools/research/codec_card.py NAME=MODEL ... [--count 24]

    python tools/research/codec_card.py "as it ships=town" \\
        "mine=runs/town_codec/town_codec.safetensors"

The scans are from a town that no model was trained on, each on another street. They are encoded,
and decoded to the mode of the predicted distributions. A flow on these latents cannot be more
accurate than this.
"""

import numpy as np
import torch
from model_card import Asked, head, open_codec, row, town
from tqdm import tqdm
from typer import run

from lidar_synth.datasets.classes import IGNORE, TRAIN_ID
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.geometry import RangeImage
from lidar_synth.geometry.projection import project
from lidar_synth.lab.train import reconstruct

SEED = 7
"""Seed of the town."""
CLASSES = ("road", "building", "fence", "vegetation", "car", "pole")


def there_and_back(asked: Asked, images: list[RangeImage]) -> list[RangeImage]:
    """Range images, encoded and decoded by the autoencoder of a checkpoint."""
    codec = open_codec(asked.model)
    made = []
    for image in tqdm(images, desc=asked.name, unit="scan"):
        made += reconstruct(codec, codec.tensors.from_images([image]), image.sensor)
    return made


def figures(real: list[RangeImage], made: list[RangeImage]) -> list[float]:
    """The figures of a line, in [0, 1]."""
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
    return [*right, *medians]


def main(models: list[str], count: int = 24) -> None:
    """Prints the table."""
    channels = ["reflectance", "label"]
    images = [project(scan, channels=channels) for scan in town(SEED, count)]
    lines = head("autoencoder", ("returns right", "labels right", *CLASSES))
    for asked in map(Asked.parse, models):
        with torch.inference_mode():
            found = figures(images, there_and_back(asked, images))
        shares = [f"{100 * share:.1f}" for share in found]
        lines.append(row(escape_markdown(asked.name), shares))
    print(
        f"{count} scans of town {SEED}; per cent: cells, labels; medians of |range / true "
        "range - 1|\n"
    )
    print("\n".join(lines))


if __name__ == "__main__":
    run(main)
