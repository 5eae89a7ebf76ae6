"""Do synthetic scans help? The same segmenter trained on a few labelled scans, without and with
synthetic ones.

Both trainings ("arms") have the same labelled scans, iterations, batch size, augmentation, network
and seeds; they differ only in the share of synthetic samples. Each is measured on the same held-out
scans. Every training runs on one thread of a process of its own, so that the figures do not depend
on the number of cores.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader
from tqdm import tqdm

from lidar_synth import MixedScans, Scan
from lidar_synth.formats.description import same_grid
from lidar_synth.lab.evaluate.segmentation import class_ious, confusion, mean_iou
from lidar_synth.lab.evaluate.segmenter import RangeSegmenter
from lidar_synth.lab.train.segmentation import endless_batches, train_segmenter
from lidar_synth.labels.augment import compose, flip_y, scale, yaw

AUGMENT = compose([yaw, flip_y, scale])
AUGMENTATION = "rotation about the vertical axis, mirroring and scaling, of real and synthetic scans alike"
WIDTHS = (8, 16, 32, 48)
"""Channels of the segmenter: half of its default, for a short training on a CPU."""


@dataclass(frozen=True)
class Protocol:
    """What both arms of a comparison share.

    Args:
        real: the labelled scans.
        synthetic: labelled synthetic scans.
        held_out: labelled scans of a place that is not in ``real``.
        ratio: share of synthetic samples in the second arm.
        steps: iterations.
        batch: samples of an iteration.
        seeds: number of repetitions of each arm, with other weights, order and augmentation.
    """

    real: Sequence[Scan]
    synthetic: Sequence[Scan]
    held_out: Sequence[Scan]
    ratio: float = 0.25
    steps: int = 100
    batch: int = 2
    seeds: int = 3

    def mixture(self, ratio: float, seed: int, **options: Any) -> MixedScans:
        """The training set of an arm, on the real scans' sensor; ``options`` are further arguments
        of ``MixedScans``."""
        sensor = self.real[0].sensor
        if not same_grid(sensor, self.synthetic[0].sensor):
            options["as_sensor"] = sensor
        return MixedScans(
            self.real, self.synthetic if ratio else None, ratio, seed=seed, **options
        )

    def train(self, ratio: float, seed: int) -> NDArray[np.int64]:
        """(19, 19) confusion matrix on the held-out scans after a training with this share of
        synthetic samples."""
        torch.manual_seed(seed)
        mixed = self.mixture(
            ratio, seed, augment=AUGMENT, augment_real=True, collate="range"
        )
        held_out = MixedScans(self.held_out, ratio=0, collate="range")
        height = torch.from_numpy(np.sin(mixed.collate.sensor.ray_angles()[0]))
        network = RangeSegmenter(widths=WIDTHS)
        train_segmenter(
            network,
            endless_batches(mixed, self.batch),
            height,
            self.steps,
            progress=False,
        )
        return confusion(
            network, DataLoader(held_out, 1, collate_fn=held_out.collate), height
        )


@dataclass(frozen=True)
class Result:
    """The outcome of a comparison: for each arm, the confusion matrix of every seed."""

    without: list[NDArray[np.int64]]
    with_synthetic: list[NDArray[np.int64]]

    def scores(self) -> tuple[list[float], list[float]]:
        """The mIoU of every seed, in [0, 1], without and with synthetic scans."""
        return [mean_iou(table) for table in self.without], [
            mean_iou(table) for table in self.with_synthetic
        ]

    def ious(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(19,) IoU of every class, mean over the seeds, without and with synthetic scans; NaN for
        a class that the held-out scans do not have."""
        there = self.without[0].sum(1) > 0
        means = [
            np.mean([np.nan_to_num(class_ious(t)) for t in tables], 0)
            for tables in (self.without, self.with_synthetic)
        ]
        return np.where(there, means[0], np.nan), np.where(there, means[1], np.nan)


_protocol: Protocol | None = None  # of this worker process


def _start(protocol: Protocol) -> None:
    global _protocol
    _protocol = protocol
    torch.set_num_threads(1)


def _train(ratio: float, seed: int) -> NDArray[np.int64]:
    assert _protocol is not None
    return _protocol.train(ratio, seed)


def compare(protocol: Protocol, jobs: int | None = None) -> Result:
    """Run both arms with every seed, in as many processes as there are cores.

    Args:
        protocol: the comparison.
        jobs: number of processes; by default one for each core.
    """
    ratios = (0.0, protocol.ratio)
    seeds = range(protocol.seeds)
    runs = [(ratio, seed) for seed in seeds for ratio in ratios]
    workers = min(jobs or os.cpu_count() or 1, len(runs))
    pool = ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=_start, initargs=(protocol,)
    )
    with pool, tqdm(total=len(runs), desc="trainings", unit="training") as bar:
        futures = [pool.submit(_train, *run) for run in runs]
        for future in futures:
            future.add_done_callback(lambda _: bar.update())
        tables = [future.result() for future in futures]
    return Result(tables[0::2], tables[1::2])
