"""Shared parts of the mixing tests: a small mixture, its loader, and a dataset of a trainer."""

from typing import Any

import numpy as np
from mixtures import Endless, Scans
from torch.utils.data import DataLoader

from lidar_synth.geometry.scan import Scan
from lidar_synth.mixing import MixedScans


def shift(scan: Scan, rng: np.random.Generator) -> Scan:
    """An augmentation that draws, and makes a new scan without a domain."""
    return Scan(
        scan.points + rng.standard_normal(3).astype(np.float32),
        scan.reflectance,
        scan.sensor,
        scan.label,
        confidence=scan.confidence,
        id=scan.id,
    )


def mixed(real: int = 9, ratio: Any = 0.4, **options: Any) -> MixedScans:
    return MixedScans(
        Scans("r", real), Endless(), ratio, augment=shift, reuse=2, **options
    )


def loader(train: MixedScans, workers: int, **options: Any) -> DataLoader[Any]:
    return DataLoader(train, num_workers=workers, collate_fn=train.collate, **options)


class Theirs:
    """A trainer's own dataset."""

    classes_of_theirs = ("car",)

    def __len__(self) -> int:
        return 5

    def __getitem__(self, index: int) -> dict[str, Any]:
        return {"pts": np.full((3, 3), index, np.float32), "name": f"theirs{index}"}
