"""Merging of several scans into one, with all fields of their points."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.datasets.classes import IGNORE
from lidar_synth.geometry import SYNTHETIC, Boxes, Scan, Sensor
from lidar_synth.geometry.assign import assign_beams
from lidar_synth.labels.boxes import join_boxes
from lidar_synth.labels.objects import find_returns, number_instances


def merge_scans(scan: Scan, others: Sequence[Scan]) -> Scan:
    """Append the points, labels and boxes of other scans to a scan.

    The ``domain`` of the result is always ``SYNTHETIC``; sensor, id, pose and image are those of
    the first scan. Labels, confidence (1 for labels of scans without confidence) and instances are
    always set; points without instances get those of their boxes. Rings are set if the first scan
    has them, as lasers of its sensor; boxes and causes are set if any scan has them. Times are
    dropped, because each scan has its own moment.

    Instances of the other scans are renumbered; so are those of a scan with ``raw_label`` and
    without boxes, because files count instances within each of their classes.
    """
    parts = [_complete(scan)]
    used = _last_instance(parts[0])
    for other in others:
        parts.append(_renumbered(_complete(other), used))
        used = max(used, _last_instance(parts[-1]))
    names = ["reflectance", "label", "confidence", "instance"]
    if scan.ring is not None:
        parts = [_with_rings(p, scan.sensor) for p in parts]
        names.append("ring")
    if any(p.cause is not None for p in parts):
        parts = [_with_causes(p) for p in parts]
        names.append("cause")
    merged: dict[str, Any] = {
        n: np.concatenate([getattr(p, n) for p in parts]) for n in ("points", *names)
    }
    boxes = [p.boxes for p in parts if p.boxes is not None]
    return replace(
        scan,
        **merged,
        raw_label=None,
        time=None,
        boxes=join_boxes(boxes) if boxes else None,
        domain=SYNTHETIC,
    )


def _with_rings(part: Scan, sensor: Sensor) -> Scan:
    """The scan with the rings of a sensor: its own if they are of the same lasers, else the
    nearest."""
    if part.ring is not None and sensor.same_lasers(part.sensor):
        return part
    return replace(part, ring=assign_beams(part, sensor).ring)


def _with_causes(part: Scan) -> Scan:
    """The scan with causes; those of a scan without any are surfaces."""
    if part.cause is not None:
        return part
    return replace(part, cause=np.zeros(len(part), np.uint8))


def _complete(scan: Scan) -> Scan:
    """The scan with labels, confidence and instances."""
    label = np.full(len(scan), IGNORE, np.uint8) if scan.label is None else scan.label
    confidence = (
        (label != IGNORE).astype(np.float32)
        if scan.confidence is None
        else scan.confidence
    )
    instance = scan.instance
    if instance is None or not instance.any():
        instance = _of_tracks(scan)
    elif scan.raw_label is not None and scan.boxes is None:  # which has the old numbers
        instance = number_instances(scan)
    return replace(scan, label=label, confidence=confidence, instance=instance)


def _of_tracks(scan: Scan) -> NDArray[np.int32]:
    """(N,) instances for the points of a scan without them, by its boxes with track ids, which
    would otherwise lose their points."""
    instance = np.zeros(len(scan), np.int32)
    if scan.boxes is not None:
        for number in np.flatnonzero(scan.boxes.instance > 0):
            mine = find_returns(scan, scan.boxes[[number]])
            instance[mine & (instance == 0)] = scan.boxes.instance[number]
    return instance


def instance_numbers(scan: Scan) -> list[NDArray[np.int32]]:
    """The instance numbers of points and boxes."""
    of_points = [] if scan.instance is None else [scan.instance]
    return of_points if scan.boxes is None else [*of_points, scan.boxes.instance]


def _last_instance(scan: Scan) -> int:
    return max(int(n.max(initial=0)) for n in instance_numbers(scan))


def _renumbered(scan: Scan, used: int) -> Scan:
    """Renumber the scan's instances as used + 1, used + 2, ...; 0 and below, which mean none, are
    kept."""
    old = np.unique(np.concatenate(instance_numbers(scan)))
    old = old[old > 0]

    def new(numbers: NDArray[np.int32]) -> NDArray[np.int32]:
        return np.where(
            numbers > 0, np.searchsorted(old, numbers) + used + 1, numbers
        ).astype(np.int32)

    assert scan.instance is not None
    boxes: Boxes | None = scan.boxes
    if boxes is not None:
        boxes = replace(boxes, instance=new(boxes.instance))
    return replace(scan, instance=new(scan.instance), boxes=boxes)
