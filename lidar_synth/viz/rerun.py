"""Scans as a recording of Rerun (https://rerun.io), whose viewer plays them. Extra ``rerun``."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lidar_synth.datasets.classes import NAMES
from lidar_synth.datasets.colours import COLOURS
from lidar_synth.errors import needs
from lidar_synth.geometry import Scan
from lidar_synth.viz.scales import make_scales, point_values


def to_rerun(
    scans: Scan | Sequence[Scan], by: str | None = None, title: str = "lidar-synth"
) -> Any:
    """Log points, boxes and poses of the sensor to a recording of Rerun.

    The timeline ``scan`` counts the scans. ``world/sensor`` has the pose (the identity where it is
    not known), ``world/sensor/points`` the points in the sensor frame, metres, with their classes,
    and ``world/sensor/boxes`` the boxes with their names.

    Args:
        scans: a scan, or several in order.
        by: the quantity that colours the points: ``height``, ``range``, ``reflectance``, ``label``,
            ``confidence`` or ``domain``; by default the label where there is one, or else the
            range.
        title: the name of the recording.

    Returns:
        A ``rerun.RecordingStream`` that buffers everything until it has a target: ``.spawn()``
        opens the viewer, ``.save("scans.rrd")`` writes a file.

    Raises:
        LibraryError: without the extra ``rerun``.
        ConfigError: on an unknown ``by``, or one that a scan does not have.
    """
    with needs("rerun", "rerun"):
        import rerun
    several = [scans] if isinstance(scans, Scan) else list(scans)
    scales = make_scales(several)
    stream = rerun.RecordingStream(title)
    classes = [(n, *pair) for n, pair in enumerate(zip(NAMES, COLOURS, strict=True))]
    stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("world", rerun.AnnotationContext(classes), static=True)
    for number, scan in enumerate(several):
        stream.set_time("scan", sequence=number)
        shown = by or ("range" if scan.label is None else "label")
        values = point_values(scan, shown)
        pose = np.eye(4) if scan.pose is None else scan.pose
        frame = rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
        points = rerun.Points3D(
            scan.points,
            colors=scales[shown](values),
            class_ids=scan.label,
        )
        stream.log("world/sensor", frame)
        stream.log("world/sensor/points", points)
        stream.log("world/sensor/boxes", _boxes(rerun, scan))
    return stream


def _boxes(rerun: Any, scan: Scan) -> Any:
    """The boxes of a scan, also if there are none: this clears those of the scan before."""
    values = np.zeros((0, 7)) if scan.boxes is None else scan.boxes.values
    half = values[:, 6:] / 2
    turns = np.column_stack([0 * half, 0 * half, np.sin(half), np.cos(half)])
    return rerun.Boxes3D(
        centers=values[:, :3],
        sizes=values[:, 3:6],
        quaternions=turns,
        labels=[] if scan.boxes is None else list(scan.boxes.names),
    )
