"""A scan with some of its returns replaced."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import SEMANTIC_KITTI
from lidar_synth.geometry.scan import SYNTHETIC, Scan
from lidar_synth.labels.edit.rays import ScanRays


def replace_returns(
    scan: Scan,
    removed: NDArray[np.bool_],
    rays: ScanRays,
    which: NDArray[np.intp],
    new: Scan,
) -> Scan:
    """Replace returns of a scan.

    Args:
        scan: N points.
        removed: (N,) True for returns that are left out.
        rays: of the scan.
        which: (n,) the ray of each new return.
        new: n returns with the fields of the scan; ring and time are set here.

    Returns:
        The scan with its remaining points unchanged and in order, and new ones in place of the
        return of their ray, or after the return before it in the ring. Its domain is ``SYNTHETIC``.
    """
    kept = scan[~removed]
    place = _place(rays, which)
    if scan.ring is not None:
        new = replace(new, ring=rays.ring[which].astype(np.int16))
    if scan.time is not None:
        new = replace(new, time=scan.time[place])
    order = np.argsort(np.concatenate([np.flatnonzero(~removed), place]), kind="stable")
    fields: dict[str, Any] = {
        "points": np.concatenate([kept.points, new.points])[order]
    }
    for name, values in kept.fields().items():
        fields[name] = np.concatenate([values, getattr(new, name)])[order].astype(
            values.dtype
        )
    if scan.raw_label is not None:
        fields["raw_label"] = _raw(kept, new, order)
    return replace(scan, **fields, domain=SYNTHETIC)


def next_instance(scan: Scan) -> int:
    """The first instance number that neither points nor boxes of a scan have."""
    used = [] if scan.instance is None else [scan.instance]
    used += [] if scan.boxes is None else [scan.boxes.instance]
    return max((int(numbers.max(initial=0)) for numbers in used), default=0) + 1


def _place(rays: ScanRays, which: NDArray[np.intp]) -> NDArray[np.int64]:
    """(n,) the return on each ray, or else the last one before it in the order of the rays."""
    there = np.maximum.accumulate(
        np.where(rays.point >= 0, np.arange(len(rays.point)), 0)
    )
    return rays.point[there[which]]


def _raw(kept: Scan, new: Scan, order: NDArray[np.intp]) -> NDArray[np.uint32] | None:
    """The labels as in the file, new points with SemanticKITTI's static classes; None for ids of
    another dataset."""
    raw = kept.raw_label
    label = new.label
    if raw is None or label is None:
        return None
    try:
        same = (
            SEMANTIC_KITTI.decode((raw & 0xFFFF).astype(np.uint16)) == kept.label
        ).all()
    except ValueError:
        return None
    instance = (
        np.zeros(len(new), np.uint32)
        if new.instance is None
        else new.instance.astype(np.uint32)
    )
    added = SEMANTIC_KITTI.encode(label).astype(np.uint32) | instance << np.uint32(16)
    return np.concatenate([raw, added])[order] if same else None
