"""Train a segmenter on real scans mixed with synthetic ones, and measure it on held-out scans.

    python tools/research/train_segmenter.py [ROOT] [--split train] [--val-split val] [--ratio 0.25]
        [--model town] [--steps 400] [--batch 4] [--workers 0] [--seed 0] [--save FILE.safetensors]

Without ROOT, scans of the town take the place of real ones, and scans of another town are held out.
ROOT is any dataset with labels per scan, SemanticKITTI for instance. The training loop is in
lidar_synth/lab/train/segmentation.py.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch.utils.data import DataLoader
from tqdm import tqdm
from typer import Argument, run

from lidar_synth import MixedScans, Scan, Source, Town, load_generator, open_scans
from lidar_synth.datasets.classes import NAMES
from lidar_synth.lab.evaluate.segmentation import Judge, class_ious, confusion, mean_iou
from lidar_synth.lab.evaluate.segmenter import RangeSegmenter
from lidar_synth.lab.train.segmentation import endless_batches, train_segmenter


def town(seed: int, count: int) -> list[Scan]:
    """Scans of one town, a second apart, kept in memory: a town is fast to read in order only."""
    source = Town(seed, scans=count, interval=1.0)
    return [source[i] for i in tqdm(range(count), desc=f"town {seed}", unit="scan")]


def fit(
    train: MixedScans, validation: Source, steps: int, batch: int, workers: int
) -> tuple[Judge, np.ndarray]:
    """A trained segmenter and its confusion matrix on held-out scans."""
    sensor = train.collate.sensor
    height = torch.from_numpy(np.sin(sensor.ray_angles()[0]))
    network = RangeSegmenter()
    train_segmenter(network, endless_batches(train, batch, workers), height, steps)
    held_out = MixedScans(validation, ratio=0, collate="range")
    loader = DataLoader(
        held_out, batch, collate_fn=held_out.collate, num_workers=workers
    )
    table = confusion(network, tqdm(loader, desc="held out"), height)
    return Judge(network, sensor, {"steps": steps, "batch": batch}), table


def print_ious(table: np.ndarray) -> None:
    """Print the IoU of each class and their mean, %."""
    for name, iou in zip(NAMES, class_ious(table), strict=True):
        print(f"{name:>16} {100 * iou:6.1f}")
    print(f"{'mIoU':>16} {100 * mean_iou(table):6.1f}")


def main(
    root: Annotated[str | None, Argument()] = None,
    split: str = "train",
    val_split: str = "val",
    scans: int = 400,
    held_out: int = 200,
    ratio: float = 0.0,
    model: str = "town",
    steps: int = 400,
    batch: int = 4,
    workers: int = 0,
    seed: int = 0,
    save: Path | None = None,
) -> None:
    """Trains, prints the IoU of each class and saves the segmenter."""
    sources: tuple[Source, Source]
    if root:
        sources = open_scans(root, split=split), open_scans(root, split=val_split)
    else:
        sources = town(0, scans), town(1, held_out)
    synthetic = load_generator(model) if ratio else None
    options = {"epoch_size": "replace", "balanced": True, "collate": "range"}
    train = MixedScans(sources[0], synthetic, ratio, seed=seed, **options)  # type: ignore[arg-type]
    torch.manual_seed(seed)
    judge, table = fit(train, sources[1], steps, batch, workers)
    print_ious(table)
    if save:
        facts = {"data": root or f"{scans} scans of town 0, a second apart"}
        facts |= {"ratio": ratio, "mIoU": mean_iou(table)}
        Judge(judge.network, judge.sensor, judge.provenance | facts).save(save)


if __name__ == "__main__":
    run(main)
