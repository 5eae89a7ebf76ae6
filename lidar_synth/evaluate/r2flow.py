"""R2Flow's protocol: bird's-eye histograms, their Jensen-Shannon distance and maximum mean discrepancy.

https://github.com/kazuto1011/r2flow, docs/TRAINING.md. Both sets are 64 x 1024 range images: real points keep
their own coordinates, generated ones lie on rays through the cells' corners; returns from 0.5 m to 63 m count,
and of them 3 m to 70 m in the histogram. 10,000 generated scans against at most 10,000 real ones.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidar_synth.errors import DataError
from lidar_synth.evaluate.distances import jensen_shannon_distance
from lidar_synth.geometry.projection import locate, project, unproject
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import presets

FIELD, BINS = 160.0, 100
"""Side of the bird's-eye square around the sensor in metres, and bins along it."""

_BLOCK = 1000  # histograms compared with one another at a time: 40 MB in float32


def cloud(scan: Scan, generated: bool) -> NDArray[np.float32]:
    """(N, 3) the points of a scan that the protocol compares, metres."""
    sensor = presets()["hdl64e_kitti360"]
    if generated:
        points = unproject(project(scan, sensor, ()), "corner").points
    else:
        shown = locate(scan.points, sensor).point
        points = scan.points[shown[shown >= 0]]
    distance: NDArray[np.float32] = np.linalg.norm(points, axis=1)
    return points[(distance > 0.5) & (distance < 63)]


def bev_histogram(points: NDArray[np.float32]) -> NDArray[np.uint32]:
    """(100, 100) number of points in each bin of x (first axis) and y; only points with 3 m < range < 70 m count.

    Args:
        points: (N, 3) float32 metres.

    Raises:
        DataError: if no point counts.
    """
    xyz = torch.from_numpy(np.ascontiguousarray(points, np.float32))
    distance = xyz.norm(dim=1)
    near = xyz[(distance > 3) & (distance < 70), :2]
    bound = FIELD / 2
    histogram = torch.histogramdd(near, BINS, range=[-bound, bound, -bound, bound]).hist
    if not histogram.any():
        raise DataError(f"a cloud of {len(points)} points with none from 3 m to 70 m", "a scan with returns")
    return histogram.numpy().astype(np.uint32)


def jsd(real: Sequence[NDArray[np.uint32]], generated: Sequence[NDArray[np.uint32]]) -> float:
    """Jensen-Shannon distance of the summed histograms."""
    empty = np.zeros((BINS, BINS), np.int64)
    return jensen_shannon_distance(sum(real, empty), sum(generated, empty))


def maximum_mean_discrepancy(real: Sequence[NDArray[np.uint32]], generated: Sequence[NDArray[np.uint32]]) -> float:
    """Squared maximum mean discrepancy of the normalised histograms, kernel exp(-|p - q|^2 / (2 sigma^2)) with
    sigma = 0.5, including pairs of a sample with itself. The paper's tables show it times 10^4."""
    return _kernel(real, real) + _kernel(generated, generated) - 2 * _kernel(real, generated)


def compare(real: Sequence[NDArray[np.uint32]], generated: Sequence[NDArray[np.uint32]]) -> dict[str, float]:
    """The figures of the protocol from the histograms of both sets."""
    return {
        "BEV Jensen-Shannon distance": jsd(real, generated),
        "BEV maximum mean discrepancy": maximum_mean_discrepancy(real, generated),
    }


def _kernel(a: Sequence[NDArray[np.uint32]], b: Sequence[NDArray[np.uint32]]) -> float:
    """Mean of the kernel minus 1. The kernel is close to 1 everywhere and the ones cancel in the sum, so that float32
    suffices without them."""
    total = 0.0
    for i in range(0, len(a), _BLOCK):
        p = _normalised(a[i : i + _BLOCK])
        for j in range(i if a is b else 0, len(b), _BLOCK):
            q = _normalised(b[j : j + _BLOCK])
            squared = p.square().sum(1)[:, None] + q.square().sum(1) - 2 * p @ q.T
            twice = 2 if a is b and j > i else 1
            total += twice * torch.expm1(-2 * squared.clamp_(min=0)).sum(dtype=torch.float64).item()
    return total / (len(a) * len(b))


def _normalised(histograms: Sequence[NDArray[np.uint32]]) -> Tensor:
    counts = torch.from_numpy(np.stack(histograms).astype(np.float32)).flatten(1)
    return counts / counts.sum(1, keepdim=True)
