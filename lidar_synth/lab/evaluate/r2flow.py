"""Bird's-eye histograms as LiDARGen introduced and R2Flow reports them:
https://github.com/kazuto1011/r2flow, ``r2flow/metrics/bev.py``. The counts and limits of the
protocol are in ``protocols/r2flow.yaml``.
"""

import numpy as np
import torch
from numpy.typing import NDArray

from lidar_synth.errors import DataError

FIELD = 160.0
BINS = 100
NEAR = 3.0
FAR = 70.0
"""Side of the bird's-eye square around the sensor in metres, bins along it, and the ranges that
count, exclusive."""


def bev_histogram(
    points: NDArray[np.float32],
    field: float = FIELD,
    bins: int = BINS,
    near: float = NEAR,
    far: float = FAR,
) -> NDArray[np.uint32]:
    """(bins, bins) number of points in each bin of x (first axis) and y; only points with near <
    range < far count.

    Args:
        points: (N, 3) float32 metres.
        field: side of the square, metres.
        bins: along each side.
        near, far: limits of the range, metres.

    Raises:
        DataError: if no point counts.
    """
    xyz = torch.from_numpy(np.ascontiguousarray(points, np.float32))
    distance = xyz.norm(dim=1)
    kept = xyz[(distance > near) & (distance < far), :2]
    bound = field / 2
    histogram = torch.histogramdd(kept, bins, range=[-bound, bound, -bound, bound]).hist
    if not histogram.any():
        raise DataError(
            f"a cloud of {len(points)} points with none from {near:g} m to {far:g} m",
            "a scan with returns",
        )
    return histogram.numpy().astype(np.uint32)
