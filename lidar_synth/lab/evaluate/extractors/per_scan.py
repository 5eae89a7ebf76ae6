"""An extractor that describes one scan at a time, with the checks that all of them share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan
from lidar_synth.geometry.arrays import Float32Array


@dataclass(frozen=True)
class PerScan:
    """An ``Extractor`` of bounded memory.

    Args:
        describe: ``(scan, generated) -> (D,)`` features.
    """

    describe: Callable[[Scan, bool], Tensor]

    def __call__(self, scans: Sequence[Scan], generated: bool = False) -> Float32Array:
        """n scans to (n, D) features; see ``Extractor``.

        Raises:
            DataError: without scans, on a scan without a return in the protocol's range, or
                features that are not finite.
        """
        if len(scans) == 0:
            raise DataError("no scans", "at least one")
        with torch.inference_mode():
            return np.stack([self._row(scan, generated) for scan in scans])

    def _row(self, scan: Scan, generated: bool) -> Float32Array:
        try:
            row: Float32Array = self.describe(scan, generated).numpy()
        except DataError as error:
            raise DataError(f"scan {scan.id!r}: {error}") from error
        if not np.isfinite(row).all():
            raise DataError(
                f"scan {scan.id!r}: features that are not finite",
                "finite points and reflectances",
            )
        return row


def some(points: Float32Array | Tensor) -> int:
    """The number of returns; a protocol needs at least one.

    Raises:
        DataError: if there is none.
    """
    if len(points) == 0:
        raise DataError("no return in the range of the protocol", "a scan with returns")
    return len(points)
