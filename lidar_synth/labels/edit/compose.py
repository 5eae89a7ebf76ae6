"""A scan with some of its returns replaced."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import MAX_INSTANCES, SEMANTIC_KITTI
from lidar_synth.geometry import SYNTHETIC, Scan
from lidar_synth.labels.edit.rays import ScanRays
from lidar_synth.labels.merge import instance_numbers


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
        return of their ray, or after the return before it in the ring. Its domain is ``SYNTHETIC``;
        it has no camera image, which would show what was there before.
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
    return replace(scan, **fields, domain=SYNTHETIC, image_path=None)


def next_instance(scan: Scan) -> int:
    """The first instance number that neither points nor boxes of a scan have, in any class of
    KITTI-360, whose numbers are id * ``MAX_INSTANCES`` + n."""
    used = np.unique(np.concatenate([[0], *instance_numbers(scan)]))
    taken = np.concatenate([used, used % MAX_INSTANCES])
    return int(np.setdiff1d(np.arange(len(taken) + 1), taken)[0])


def _place(rays: ScanRays, which: NDArray[np.intp]) -> NDArray[np.int64]:
    """(n,) the return on each ray, or else the last one before it in the order of the rays."""
    latest = np.maximum.accumulate(
        np.where(rays.point >= 0, np.arange(len(rays.point)), 0)
    )
    return rays.point[latest[which]]


def _raw(kept: Scan, new: Scan, order: NDArray[np.intp]) -> NDArray[np.uint32] | None:
    """The labels as in SemanticKITTI's files, with static classes for new points that have none;
    None for ids of another dataset."""
    if kept.raw_label is None or new.label is None or _classes(kept) is None:
        return None
    classes = _classes(new)
    if classes is None:
        classes = SEMANTIC_KITTI.encode(new.label)
    if new.instance is not None:
        classes = classes | new.instance.astype(np.uint32) << np.uint32(16)
    return np.concatenate([kept.raw_label, classes])[order]


def _classes(scan: Scan) -> NDArray[np.uint32] | None:
    """(N,) SemanticKITTI's classes of a scan's ``raw_label``; None if its labels are others."""
    assert scan.raw_label is not None
    classes = scan.raw_label & np.uint32(0xFFFF)
    try:
        same = SEMANTIC_KITTI.decode(classes.astype(np.uint16)) == scan.label
    except ValueError:
        return None
    return classes if same.all() else None
