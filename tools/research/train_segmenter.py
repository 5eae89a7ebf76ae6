"""Train a segmenter on real scans mixed with synthetic ones, and measure it on held-out scans.

    python tools/research/train_segmenter.py [ROOT] [--split train] [--val-split val] [--ratio 0.25] [--model town]
        [--steps 400] [--batch 4] [--workers 0] [--seed 0] [--save FILE.safetensors]

Without ROOT, scans of the town take the place of real ones, and scans of another town are held out.
ROOT is any dataset with labels per scan, SemanticKITTI for instance. The training loop is in
lidar_synth/lab/train/segmentation.py.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import DataLoader
from tqdm import tqdm

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
    train: MixedScans,
    validation: Source,
    steps: int,
    batch: int,
    workers: int,
    seed: int,
) -> tuple[Judge, np.ndarray]:
    """A trained segmenter and its confusion matrix on held-out scans."""
    torch.manual_seed(seed)
    sensor = train.collate.sensor
    height = torch.from_numpy(np.sin(sensor.ray_angles()[0]))
    network = RangeSegmenter()
    train_segmenter(network, endless_batches(train, batch, workers), height, steps)
    held_out = MixedScans(validation, ratio=0, collate="range")
    loader = DataLoader(
        held_out, batch, collate_fn=held_out.collate, num_workers=workers
    )
    table = confusion(network, tqdm(loader, desc="held out"), height)
    return Judge(network, sensor, {}), table


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "root", nargs="?", help="a labelled dataset [default: the town]"
    )
    parser.add_argument("--split", default="train")
    parser.add_argument("--val-split", default="val")
    parser.add_argument("--scans", type=int, default=400, help="scans of the town")
    parser.add_argument(
        "--held-out", type=int, default=200, help="held-out scans, of another town"
    )
    parser.add_argument(
        "--ratio", type=float, default=0.0, help="share of synthetic scans"
    )
    parser.add_argument("--model", default="town", help="model of the synthetic scans")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", type=Path)
    given = parser.parse_args()

    if given.root:
        real = open_scans(given.root, split=given.split)
        validation = open_scans(given.root, split=given.val_split)
    else:
        real = town(0, given.scans)
        validation = town(1, given.held_out)
    synthetic = load_generator(given.model) if given.ratio else None
    train = MixedScans(
        real,
        synthetic,
        given.ratio,
        seed=given.seed,
        epoch_size="replace",
        balanced=True,
        collate="range",
    )
    judge, table = fit(
        train, validation, given.steps, given.batch, given.workers, given.seed
    )
    for name, iou in zip(NAMES, class_ious(table), strict=True):
        print(f"{name:>16} {100 * iou:6.1f}")
    print(f"{'mIoU':>16} {100 * mean_iou(table):6.1f}")
    if given.save:
        data = given.root or f"{given.scans} scans of town 0, a second apart"
        provenance = {
            "data": data,
            "ratio": given.ratio,
            "steps": given.steps,
            "batch": given.batch,
            "mIoU": mean_iou(table),
        }
        Judge(judge.network, judge.sensor, provenance).save(given.save)


if __name__ == "__main__":
    main()
