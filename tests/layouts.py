"""Small datasets in every layout that can be written, for tests of readers, conversion and bad
input."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from banks import write_bank
from conftest import random_scan
from pandaset_files import write_pandaset
from py123d_files import copy_logs

from lidar_synth.formats import WRITERS
from lidar_synth.formats.calibration import AXES_CAMERA_FROM_SENSOR, Calibration
from lidar_synth.geometry.projection import project
from lidar_synth.geometry.scan import Boxes, Scan
from lidar_synth.geometry.sensor import load_sensor

WRITTEN_AS = {
    "kitti": "folder",
    "semantic_kitti": "semantic_kitti",
    "kitti_object": "kitti_object",
    "kitti360": "kitti360",
    "range": "range",
    "pcd": "folder",
    "ply": "folder",
    "npz": "folder",
    "png": "png",
    "webdataset": "webdataset",
    "mcap": "mcap",
    "cosmos": "cosmos",
}
"""Which reader reads what each writer writes."""


def turn(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """(3, 3) rotation about z, then y, then x."""
    about_z = np.array(
        [(np.cos(yaw), -np.sin(yaw), 0), (np.sin(yaw), np.cos(yaw), 0), (0, 0, 1)]
    )
    about_y = np.array(
        [
            (np.cos(pitch), 0, np.sin(pitch)),
            (0, 1, 0),
            (-np.sin(pitch), 0, np.cos(pitch)),
        ]
    )
    about_x = np.array(
        [(1, 0, 0), (0, np.cos(roll), -np.sin(roll)), (0, np.sin(roll), np.cos(roll))]
    )
    return about_z @ about_y @ about_x


def a_pose(seed: int = 0) -> np.ndarray:
    """(4, 4) a rigid transform: far away, turned and slightly tilted, as a drive's poses are."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = turn(rng.uniform(-np.pi, np.pi), *rng.uniform(-0.05, 0.05, 2))
    pose[:3, 3] = rng.uniform(-4000, 4000, 3)
    return pose


def some_boxes(seed: int = 0, count: int = 5) -> Boxes:
    """Boxes ahead of the sensor, where a camera sees them."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform((8, -4, -1.5), (50, 4, 0), (count, 3))
    size = rng.uniform((0.5, 0.5, 1.4), (5, 2, 2), (count, 3))
    names = rng.choice(["Car", "Truck", "Pedestrian", "Cyclist"], count).tolist()
    values = np.column_stack([centre, size, rng.uniform(-3.1, 3.1, count)])
    return Boxes(
        values.astype(np.float32),
        names,
        instance=np.arange(1, count + 1, dtype=np.int32),
    )


def some_camera() -> Calibration:
    """A camera beside the sensor that leans a little, as real ones do."""
    moved = AXES_CAMERA_FROM_SENSOR.copy()
    moved[:3, :3] = moved[:3, :3] @ turn(0.01, -0.015, 0.008)
    moved[:3, 3] = 0.05, -0.08, -0.27
    return Calibration(
        np.array([(600.0, 0, 350, 45), (0, 600, 130, 0), (0, 0, 1, 0.005)]),
        moved,
        (700, 260),
    )


def some_scan(seed: int = 0, sensor: str = "hdl64e_kitti", count: int = 600) -> Scan:
    """A scan with everything that a scan can have, but an image; nothing nearer or farther than the
    sensor sees."""
    scan = random_scan(load_sensor(sensor), count, seed)
    distance = np.linalg.norm(scan.points, axis=1)
    scan = scan[(distance > scan.sensor.range_min) & (distance < scan.sensor.range_max)]
    scan.boxes = some_boxes(seed)
    scan.pose = a_pose(seed)
    return scan


def write_all(to: str, root: Path, scans: list[Scan], **options: object) -> list[Path]:
    """Write scans by index; the file of each that says it is whole."""
    writer = WRITERS[to](root, **options)  # type: ignore[arg-type]
    for index, scan in enumerate(scans):
        writer.write(scan, index)
    writer.finish()
    return [writer.path(index) for index in range(len(scans))]


def write_tars(root: Path) -> list[Path]:
    """Three scans as WebDataset's files, one in each; the files."""
    write_all("webdataset", root, [some_scan(i) for i in range(3)], shard_size=1)
    return sorted(root.glob("*.tar"))


def nuscenes_arrays(count: int = 320, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(N, 5) a sweep as nuScenes stores it, and (N,) lidarseg classes."""
    rng = np.random.default_rng(seed)
    ring = np.tile(np.arange(32), count // 32)
    elevation = np.radians(-30 + 1.3 * ring)
    azimuth = rng.uniform(-np.pi, np.pi, count)
    distance = np.where(rng.random(count) < 0.1, 0.3, rng.uniform(2, 90, count))
    x = np.cos(elevation) * np.sin(azimuth)
    y = np.cos(elevation) * np.cos(azimuth)
    points = np.stack([x, y, np.sin(elevation)], -1) * distance[:, None]
    return np.column_stack([points, rng.integers(0, 256, count), ring]).astype(
        "<f4"
    ), rng.integers(0, 32, count)


def write_nuscenes(root: Path, count: int = 3, labels: bool = True) -> list[Path]:
    """A nuScenes folder with lidarseg; the sweeps' files."""
    paths = []
    samples = []
    segments = []
    for i in range(count):
        points, classes = nuscenes_arrays(seed=i)
        paths.append(root / "samples" / "LIDAR_TOP" / f"n015__LIDAR_TOP__{i}.pcd.bin")
        paths[-1].parent.mkdir(parents=True, exist_ok=True)
        points.tofile(paths[-1])
        if labels:
            file = root / "lidarseg" / "v1.0-mini" / f"token{i}_lidarseg.bin"
            file.parent.mkdir(parents=True, exist_ok=True)
            classes.astype("u1").tofile(file)
            samples.append(
                {
                    "token": f"token{i}",
                    "filename": f"samples/LIDAR_TOP/{paths[-1].name}",
                }
            )
            segments.append(
                {
                    "sample_data_token": f"token{i}",
                    "filename": file.relative_to(root).as_posix(),
                }
            )
    if labels:
        (root / "v1.0-mini").mkdir()
        (root / "v1.0-mini" / "sample_data.json").write_text(json.dumps(samples))
        (root / "v1.0-mini" / "lidarseg.json").write_text(json.dumps(segments))
    return paths


def write_kitti_raw(root: Path, count: int = 3) -> list[Path]:
    """A KITTI raw drive with one tracklet; the scans' files."""
    drive = root / "2011_09_26" / "2011_09_26_drive_0001_sync"
    paths = [drive / "velodyne_points" / "data" / f"{i:010d}.bin" for i in range(count)]
    paths[0].parent.mkdir(parents=True)
    for i, path in enumerate(paths):
        scan = some_scan(i)
        np.column_stack([scan.points, scan.reflectance]).astype("<f4").tofile(path)
    pose = (
        "<item><tx>10</tx><ty>{}</ty><tz>-1.5</tz><rz>{}</rz>"
        "<occlusion>1</occlusion><truncation>0</truncation></item>"
    )
    poses = "".join(pose.format(k, 4 + k) for k in range(count - 1))
    (drive / "tracklet_labels.xml").write_text(
        "<boost_serialization><tracklets><count>1</count><item><objectType>Person "
        "(sitting)</objectType>"
        f"<h>1.2</h><w>0.8</w><l>0.9</l><first_frame>1</first_frame><poses>{poses}</poses></item>"
        "</tracklets></boost_serialization>"
    )
    return paths


MAKERS: dict[str, Callable[[Path], list[Path]]] = {
    "bank": lambda root: write_bank(
        root, [project(some_scan(i)) for i in range(3)], shard_size=1
    ),
    "kitti360": lambda root: write_all(
        "kitti360", root, [some_scan(i) for i in range(3)]
    ),
    "semantic_kitti": lambda root: write_all(
        "semantic_kitti", root, [some_scan(i) for i in range(3)]
    ),
    "kitti_object": lambda root: write_all(
        "kitti_object", root, [some_scan(i) for i in range(3)]
    ),
    "folder": lambda root: write_all("kitti", root, [some_scan(i) for i in range(3)]),
    "range": lambda root: write_all("range", root, [some_scan(i) for i in range(3)]),
    "png": lambda root: write_all("png", root, [some_scan(i) for i in range(3)]),
    "webdataset": write_tars,
    "mcap": lambda root: write_all("mcap", root, [some_scan(i) for i in range(3)]),
    "cosmos": lambda root: write_all("cosmos", root, [some_scan(i) for i in range(3)]),
    "py123d": copy_logs,
    "nuscenes": write_nuscenes,
    "pandaset": write_pandaset,
    "kitti_raw": write_kitti_raw,
}
"""By layout: write three scans under a folder; the file of each."""
