"""A small segmenter trained on scans of the town only, tested on real scans: mIoU and IoU by class.

    python tools/zero_shot.py SEMANTIC_KITTI [--pandaset FOLDER] [--streets 200] [--steps 500]
    [--seeds 2] [--skin NAME]

SEMANTIC_KITTI is a folder of labelled real scans in that layout; they are only tested on. FOLDER
holds PandaSet, read with ``--pandaset``, whose scans are projected onto the same grid; its classes
are pooled to those that both have. The network is the package's ``RangeSegmenter`` at 64 x 512,
trained with batches of 4 that are turned and mirrored.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from lidar_synth import open_scans
from lidar_synth.datasets.classes import NAMES, TRAIN_ID
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import Sensor
from lidar_synth.lab.evaluate.segmentation import class_ious, confusion
from lidar_synth.lab.evaluate.segmenter import RangeSegmenter
from lidar_synth.lab.town import STRETCH_FRAMES, Town
from lidar_synth.lab.train.segmentation import train_segmenter

GRID = Sensor("64 x 512", 512, range_min=1.0, range_max=80.0, rows=64, fov_up=3.0, fov_down=-25.0)
CHANNELS = ("reflectance", "label")
POOLS = {
    "vehicle": ("car", "truck", "other-vehicle"),
    "road": ("road",),
    "walkable": ("sidewalk", "parking", "other-ground", "terrain"),
    "building": ("building",),
    "vegetation": ("vegetation", "trunk"),
}
"""Classes that SemanticKITTI and PandaSet label alike, once they are pooled."""


def images(scans: Sequence[Scan]) -> dict[str, Tensor]:
    """Range, reflectance and label of scans on the grid, each (n, H, W)."""
    views = [project(scan, GRID, CHANNELS) for scan in scans]
    stacks = {name: np.stack([view.channels[name] for view in views]) for name in CHANNELS}
    return {
        "range": torch.from_numpy(np.stack([v.range for v in views])),
        **{k: torch.from_numpy(v) for k, v in stacks.items()},
    }


def town_scans(streets: int, seed: int, **options: Any) -> list[Scan]:
    """One scan of each of the first streets of a town."""
    town = Town(seed, scans=streets * STRETCH_FRAMES, **options)
    return [
        town[street * STRETCH_FRAMES + 7]
        for street in tqdm(range(streets), desc="town", unit="scan")
    ]


def batches(data: dict[str, Tensor], seed: int, size: int = 4) -> Iterator[dict[str, Tensor]]:
    """Endless batches of random images, turned and mirrored."""
    rng = np.random.default_rng(seed)
    while True:
        picks = rng.choice(len(data["range"]), size, replace=False)
        turns = rng.integers(0, GRID.columns, size)
        mirrored = rng.random(size) < 0.5
        batch = {}
        for name, values in data.items():
            rows = [values[i].roll(int(t), -1) for i, t in zip(picks, turns, strict=True)]
            batch[name] = torch.stack(
                [r.flip(-1) if m else r for r, m in zip(rows, mirrored, strict=True)]
            )
        yield batch


def pooled(table: NDArray[np.int64]) -> NDArray[np.float64]:
    """IoU of each pool of ``POOLS`` from a confusion table (19, 19); other labels are left out."""
    pool = np.full(len(NAMES), len(POOLS))
    for i, names in enumerate(POOLS.values()):
        pool[[TRAIN_ID[name] for name in names]] = i
    small = np.zeros((len(POOLS) + 1, len(POOLS) + 1), np.int64)
    np.add.at(small, (pool[:, None], pool[None]), table)
    small = small[:-1]
    hits = np.diagonal(small)
    return hits / np.maximum(1, small.sum(1) + small[:, :-1].sum(0) - hits)


def report(name: str, tables: list[NDArray[np.int64]], pool: bool) -> str:
    """A line of the table: mean and spread of mIoU over seeds, then IoU by class of the first
    classes."""
    ious = np.array([pooled(t) if pool else class_ious(t)[t.sum(1) > 0] for t in tables])
    names = (
        list(POOLS)
        if pool
        else [n for n, total in zip(NAMES, tables[0].sum(1), strict=True) if total]
    )
    means = 100 * ious.mean(1)
    cells = ", ".join(f"{n} {100 * v:.0f}" for n, v in zip(names, ious.mean(0), strict=True))
    accuracy = 100 * np.mean([np.trace(t) / t.sum() for t in tables])
    return f"| {name} | {means.mean():.1f} +- {means.std():.1f} | {accuracy:.1f} | {cells} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "real", type=Path, help="labelled scans in the layout of SemanticKITTI, to test on"
    )
    parser.add_argument("--pandaset", type=Path, help="labelled scans of PandaSet, to test on")
    parser.add_argument("--streets", type=int, default=200)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--skin", help="a skin of the town")
    options = parser.parse_args()
    tests = {"SemanticKITTI": (images(list(open_scans(options.real))), False)}
    if options.pandaset:
        tests["PandaSet, pooled"] = (images(list(open_scans(options.pandaset))), True)
        tests["SemanticKITTI, pooled"] = (tests["SemanticKITTI"][0], True)
    data = images(
        town_scans(options.streets, 3, **({"skin": options.skin} if options.skin else {}))
    )
    height = torch.from_numpy(np.sin(GRID.ray_angles()[0]))
    tables: dict[str, list[NDArray[np.int64]]] = {name: [] for name in tests}
    for seed in range(options.seeds):
        torch.manual_seed(seed)
        network = RangeSegmenter()
        train_segmenter(network, batches(data, seed), height, options.steps)
        for name, (real, _) in tests.items():
            ones = ({k: v[i : i + 1] for k, v in real.items()} for i in range(len(real["range"])))
            tables[name].append(confusion(network, ones, height))
    print("| tested on | mIoU | accuracy | IoU by class |\n|---|---:|---:|---|")
    for name, (_, pool) in tests.items():
        print(report(name, tables[name], pool))


if __name__ == "__main__":
    main()
