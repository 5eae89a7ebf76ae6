"""Bird's-eye histograms by class, for scans with labels: what S-JSD and S-MMD compare.

SPIRAL (Zhu et al., NeurIPS 2025, https://arxiv.org/abs/2505.22643) compares one bird's-eye
histogram per class. Its code could not be read: its grid and its normalisation are not known. Here
the grid is R2Flow's, and a scan's histograms of all classes together sum to 1.
"""

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE, NAMES
from lidar_synth.errors import DataError
from lidar_synth.geometry import Scan
from lidar_synth.lab.evaluate.r2flow import BINS, FAR, FIELD, NEAR
from lidar_synth.lab.evaluate.statistics import Sparse

CLASSES = len(NAMES)


def require_label(scan: Scan) -> NDArray[np.uint8]:
    """(N,) the labels of a scan.

    Raises:
        DataError: on a scan without labels.
    """
    if scan.label is None:
        raise DataError(f"scan {scan.id!r} without labels", "labelled scans")
    return scan.label


def class_histogram(
    scan: Scan,
    field: float = FIELD,
    bins: int = BINS,
    near: float = NEAR,
    far: float = FAR,
) -> Sparse:
    """The bins that are not empty of (19, bins, bins): class, then x, then y. Ignored points do not
    count.

    Args:
        scan: with labels.
        field: side of the bird's-eye square, metres.
        bins: along each side.
        near, far: limits of the range, exclusive, metres.

    Raises:
        DataError: on a scan without labels, or without a labelled point between the limits.
    """
    label = require_label(scan)
    distance = np.linalg.norm(scan.points, axis=1)
    cell = np.floor((scan.points[:, :2] / field + 0.5) * bins).astype(np.int64)
    kept = (
        (label != IGNORE)
        & (distance > near)
        & (distance < far)
        & ((cell >= 0) & (cell < bins)).all(1)
    )
    if not kept.any():
        raise DataError(
            f"scan {scan.id!r} with no labelled return from {near:g} m to {far:g} m",
            "labelled returns",
        )
    row, column = cell[kept].T
    index = (label[kept].astype(np.int64) * bins + row) * bins + column
    where, amounts = np.unique(index, return_counts=True)
    return Sparse(where.astype(np.int32), amounts.astype(np.uint16))


def class_shares(scan: Scan, bands: int = 16) -> NDArray[np.float64]:
    """(bands * 19,) share of each class among the labelled points, in rings around the sensor of
    equal width to 56 m.

    Raises:
        DataError: on a scan without labels.
    """
    label = require_label(scan)
    ring = np.minimum(
        np.linalg.norm(scan.points[:, :2], axis=1) * bands / 56, bands - 1
    ).astype(np.int64)
    known = label != IGNORE
    counts = np.bincount(
        ring[known] * CLASSES + label[known], minlength=bands * CLASSES
    )
    table = counts.reshape(bands, CLASSES).astype(np.float64)
    shares: NDArray[np.float64] = table / np.maximum(table.sum(1, keepdims=True), 1)
    return shares.ravel()
