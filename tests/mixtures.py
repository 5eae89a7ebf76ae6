"""Small sources of scans for the tests of mixing."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from conftest import random_scan

from lidar_synth.geometry.scan import REAL, SYNTHETIC, Scan
from lidar_synth.geometry.sensor import Sensor

SENSOR = Sensor("small", 32, 1.45, 80.0, rows=8, fov_up=3.0, fov_down=-25.0)


class Scans(list[Scan]):
    """Scans in memory; ``<name><i>`` with 20 to 29 points each."""

    def __init__(
        self,
        name: str,
        count: int,
        sensor: Sensor = SENSOR,
        domain: int = REAL,
        seed: int = 0,
    ) -> None:
        scans = (
            random_scan(sensor, 20 + i % 10, seed=1000 * seed + i) for i in range(count)
        )
        super().__init__(
            replace(scan, id=f"{name}{i}", domain=domain)
            for i, scan in enumerate(scans)
        )
        self.sensor = sensor


class Endless:
    """Synthetic scans without end: ``s<number>``, of which the number decides everything."""

    sensor = SENSOR
    length = None

    def __init__(
        self,
        fields: Sequence[str] = ("reflectance", "label", "confidence"),
        name: str = "s",
    ) -> None:
        self.fields = frozenset(fields)
        self.identity = name

    def __getitem__(self, number: int) -> Scan:
        scan = random_scan(SENSOR, 15 + number % 7, seed=10_000 + number)
        confidence = (
            np.full(len(scan), 0.5, np.float32) if "confidence" in self.fields else None
        )
        label = scan.label if "label" in self.fields else None
        return replace(
            scan,
            label=label,
            raw_label=None,
            confidence=confidence,
            id=f"{self.identity}{number}",
            domain=SYNTHETIC,
        )


class Told:
    """A trainer's own dataset: its samples tell the epoch that was set."""

    epoch = 0

    def __init__(self, count: int) -> None:
        self.count = count

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> str:
        return f"r{index} of epoch {self.epoch}"


def plain(sample: Any) -> Any:
    """A sample or batch in values that compare by ``==``, bit for bit."""
    if isinstance(sample, dict):
        return {key: plain(value) for key, value in sample.items()}
    if isinstance(sample, torch.Tensor | np.ndarray):
        array = np.asarray(sample)
        return array.shape, str(array.dtype), array.tobytes()
    return sample


def as_is(scan: Scan, rng: np.random.Generator) -> Scan:
    return scan
