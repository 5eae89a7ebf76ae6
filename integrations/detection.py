"""Additional data for detectors: ground plane, camera view, difficulty, and a database of objects.

KITTI's trainers use the points and boxes in the view of camera 2, and shift pasted objects to the
ground by a plane ``a x + b y + c z + d = 0`` in the rectified camera frame, whose normal points up
(b < 0).
"""

import pickle
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from lidar_synth.integrations.nuscenes import (
    nuscenes_names,
    turned_boxes,
    turned_points,
)
from numpy.typing import NDArray

from lidar_synth.datasets.classes import GROUND, has_ground
from lidar_synth.errors import DataError
from lidar_synth.files.disk import write_file
from lidar_synth.formats.calibration import Calibration
from lidar_synth.formats.kitti_object import OBJECT_CAMERA
from lidar_synth.formats.nuscenes import INTENSITY_MAX
from lidar_synth.geometry import Boxes, Scan
from lidar_synth.labels import ObjectBank

NEAR = 40.0
"""Maximum distance of ground returns for the plane, metres."""

LEVELS = ((40, 0.15, 0), (25, 0.30, 1), (25, 0.50, 2))
"""KITTI's easy, moderate and hard: minimum height in pixels, maximum truncation and occlusion
(devkit's readme)."""

LOOKED_AT = 16
"""Maximum number of synthetic scans whose boxes are checked before training."""

BOXES_HINT = "labels: paste with a bank of objects gives a scan boxes, labels: boxes keeps its own."

Origin = Literal["gravity", "bottom"]
"""The reference point of a box: its centre of gravity (OpenPCDet) or the centre of its floor
(MMDetection3D)."""


def ground_plane(scan: Scan) -> NDArray[np.float64]:
    """Fit the ground plane: (4,) a, b, c, d in the sensor frame, with (a, b, c) of length 1 and
    pointing up.

    It is fitted to the returns with ground labels, or without such labels to the lowest return in
    each square of 2 m; returns farther than 0.3 m from the plane are outliers.

    Raises:
        DataError: if there is no ground.
    """
    near = scan[np.hypot(scan.points[:, 0], scan.points[:, 1]) < NEAR]
    points = near.points.astype(np.float64)
    if has_ground(near.label):
        points = points[GROUND[near.label]]
    elif len(points):
        points = _lowest(points)
    fit = np.array([0, 0, np.median(points[:, 2])]) if len(points) else np.zeros(3)
    sides = np.c_[points[:, :2], np.ones(len(points))]
    for reach in (1.0, 0.5, 0.3, 0.3):
        close = np.abs(points[:, 2] - sides @ fit) < reach
        if close.sum() < 10:
            raise DataError(
                f"scan {scan.id!r} has {close.sum()} returns of the ground",
                "ground for a plane",
            )
        fit = np.linalg.lstsq(sides[close], points[close, 2], rcond=None)[0]
    plane: NDArray[np.float64] = np.array(
        [-fit[0], -fit[1], 1, -fit[2]]
    ) / np.linalg.norm([fit[0], fit[1], 1])
    return plane


def _lowest(points: NDArray[np.float64]) -> NDArray[np.float64]:
    cell = np.floor(points[:, :2] / 2).astype(np.int64) @ (1, 1 << 20)
    order = np.lexsort((points[:, 2], cell))
    return points[order[np.r_[True, np.diff(cell[order]) != 0]]]


def require_boxes(scan: Scan, known: Collection[str]) -> Boxes:
    """The boxes of a synthetic scan, for a detector; they may be zero in number.

    Args:
        scan: a synthetic scan.
        known: the class names that the trainer knows; it drops boxes of others silently, and their
            points become background.

    Raises:
        DataError: if ``scan.boxes`` is None, or on a box with another name.
    """
    if scan.boxes is None:
        raise DataError(
            f"synthetic scan {scan.id!r} has no boxes",
            "boxes, or every object in it would be background",
            BOXES_HINT,
        )
    if lost := sorted(set(scan.boxes.names) - set(known)):
        raise DataError(
            f"boxes of {lost} in synthetic scan {scan.id!r}",
            f"some of {', '.join(known)}",
            "The trainer drops boxes of other names. Rename them to its classes.",
        )
    return scan.boxes


def plane_in_camera(
    plane: NDArray[np.float64], camera: Calibration
) -> NDArray[np.float64]:
    """(4,) a plane of the sensor frame, transformed to the camera frame."""
    moved: NDArray[np.float64] = plane @ camera.sensor_from_camera
    return moved


def difficulty(boxes: Boxes) -> NDArray[np.int32]:
    """(M,) KITTI's level of each box: 0 easy, 1 moderate, 2 hard, -1 none of them, or unknown
    occlusion.

    An unknown height in the image is computed from the box's height and distance with KITTI's focal
    length.
    """
    known = (boxes.image_box >= 0).all(1)
    distance = np.maximum(np.hypot(boxes.values[:, 0], boxes.values[:, 1]), 1)
    apparent = OBJECT_CAMERA.projection[1, 1] * boxes.values[:, 5] / distance
    height = np.where(known, boxes.image_box[:, 3] - boxes.image_box[:, 1], apparent)
    level = np.full(len(boxes), -1, np.int32)
    for number, (least, truncated, occluded) in reversed(list(enumerate(LEVELS))):
        fits = (
            (height >= least)
            & (boxes.truncation <= truncated)
            & (boxes.occlusion <= occluded)
        )
        level[fits & (boxes.occlusion >= 0)] = number
    return level


def write_gt_database(
    objects: ObjectBank,
    root: str | Path,
    *,
    origin: Origin,
    folder: str = "gt_database",
    infos: str,
    layout: Literal["kitti", "nuscenes"] = "kitti",
) -> Path:
    """Write a bank of objects as the database of a trainer's GT sampling.

    Points are relative to the trainer's reference point of the box. The list of objects is a
    pickle, because both trainers read one; the package only writes it. Trainers leave
    out objects of difficulty -1. Unknown occlusion therefore counts as none, and nuScenes' objects
    have difficulty 0, as in MMDetection3D's own database.

    Args:
        objects: of any source with boxes, ``ObjectBank.from_scans(source)``.
        root: the trainer's data folder.
        origin: ``"gravity"`` for OpenPCDet, ``"bottom"`` for MMDetection3D.
        folder: of the points, under the root.
        infos: name of the list, such as ``kitti_dbinfos_train.pkl``.
        layout: ``"nuscenes"`` turns the objects to nuScenes' frame and gives them its names, points
            of five values (intensity 0..255, time 0) and boxes with a velocity of zero; objects of
            classes that it lacks are left out.

    Returns:
        The list's file.

    Raises:
        DataError: for nuScenes, on a name that ``nuscenes.NAMES`` does not have.
        FileError: if it cannot be written.
    """
    root = Path(root)
    listed = dict[str, list[dict[str, Any]]]()
    names: Sequence[str | None] = objects.boxes.names
    if layout == "nuscenes":
        names = nuscenes_names(objects.boxes.names, "the bank of objects")
        level = np.zeros(len(objects.boxes), np.int32)
    else:
        clipped = objects.boxes.occlusion.clip(min=0)
        level = difficulty(replace(objects.boxes, occlusion=clipped))
    for i, name in enumerate(names):
        if name is None:
            continue
        box, values = _gt_object(objects, i, origin, layout)
        scan = re.sub(r"\W+", "_", str(objects.scan[i]))
        # Numbered in the bank, as scans of two folders may have one name.
        path = f"{folder}/{scan}_{name}_{i}.bin"
        write_file(root / path, values.astype("<f4").tobytes())
        facts = {
            "name": name,
            "path": path,
            "image_idx": scan,
            "gt_idx": int(objects.number[i]),
            "box3d_lidar": box,
            "num_points_in_gt": len(values),
            "difficulty": int(level[i]),
            "group_id": i,
            "score": -1.0,
            "bbox": objects.boxes.image_box[i],
        }
        listed.setdefault(name, []).append(facts)
    write_file(root / infos, pickle.dumps(listed))
    return root / infos


def _gt_object(
    objects: ObjectBank, number: int, origin: Origin, layout: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The box of an object, (7,) or nuScenes' (9,), and the values of its points, (N, 4) or (N, 5),
    as a trainer's database has them."""
    part = slice(objects.start[number], objects.start[number + 1])
    boxes = objects.boxes[[number]]
    points = objects.points[part].copy()
    reflectance = objects.reflectance[part]
    if layout == "nuscenes":
        boxes = turned_boxes(boxes)
        points = turned_points(points)
    box = boxes.values[0].copy()
    if origin == "bottom":
        box[2] -= box[5] / 2
        points[:, 2] += box[5] / 2
    if layout != "nuscenes":
        return box, np.column_stack([points, reflectance])
    time = np.zeros(len(points), np.float32)
    values = np.column_stack([points, reflectance * INTENSITY_MAX, time])
    return np.append(box, np.zeros(2, np.float32)), values
