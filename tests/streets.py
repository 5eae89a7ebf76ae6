"""Small "real" and synthetic datasets on disk for the tests of trainers, in every layout that the
trainers read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from box_scenes import car, cast, wall
from layouts import write_all
from lidar_synth.integrations.folders import write_planes

from lidar_synth.formats.calibration import AXES_CAMERA_FROM_SENSOR, Calibration
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.geometry.sensor import Sensor

SENSOR = Sensor("small", 256, 2.0, 80.0, rows=32, fov_up=3.0, fov_down=-25.0)
CAMERA = Calibration(
    np.array([(700.0, 0, 600, 0), (0, 700, 250, 0), (0, 0, 1, 0)]),
    AXES_CAMERA_FROM_SENSOR,
    (1200, 700),
)


def street(seed: int, boxes: bool = True) -> Scan:
    """A street with two cars ahead of the sensor, 7 to 18 m away, and one behind it."""
    rng = np.random.default_rng(seed)
    cars = [car(rng.uniform(7, 18), y, rng.uniform(-3, 3)) for y in (-2.5, 2.5)] + [
        car(-9, 2, 0.3)
    ]
    scan = cast(
        cars,
        [wall(20, -9), wall(20, 9), wall(30, 0, 1.5)],
        sensor=SENSOR,
        id=f"street-{seed}",
    )
    scan.reflectance = rng.random(len(scan)).astype(np.float32)
    assert scan.boxes is not None
    seen = replace(
        scan.boxes, occlusion=np.zeros(3, np.int8), truncation=np.zeros(3, np.float32)
    )
    return replace(
        scan, boxes=seen if boxes else Boxes(np.zeros((0, 7), np.float32), ())
    )


def kitti(root: Path, count: int, boxes: bool = True) -> Path:
    """Write scans in KITTI's object layout, which count as real."""
    write_all(
        "kitti_object",
        root,
        [street(i, boxes) for i in range(count)],
        calibration=CAMERA,
    )
    write_planes(root)
    return root


def semantic_kitti(root: Path, count: int) -> Path:
    """Write scans in SemanticKITTI's layout, sequence 00, which count as real."""
    write_all("semantic_kitti", root, [street(i) for i in range(count)])
    return root


def synthetic(root: Path, count: int, boxes: bool = True, labels: bool = True) -> Path:
    """Write a folder of synthetic scans with labels and boxes."""
    scans = [street(1000 + i, boxes) for i in range(count)]
    scans = [
        s if labels else replace(s, label=None, raw_label=None, instance=None)
        for s in scans
    ]
    write_all("npz", root, [replace(s, domain=1) for s in scans])
    return root


def held(boxes: Boxes, points: np.ndarray) -> np.ndarray:
    """(M,) number of points in each box, enlarged by 2 cm on each side to contain all returns of a
    car; without the road."""
    wide = boxes.values + np.array([0, 0, 0, 0.04, 0.04, 0.04, 0], np.float32)
    return Boxes(wide, boxes.names).contain(points, 0.1).sum(1)
