"""Recovered labels on real scans: PandaSet's, accumulated as KITTI-360's, whose own clouds are not
at hand.

Every second of 16 frames of a Pandar64 is accumulated, in KITTI-360's layout; the labels of all are
recovered from them. The scans are compensated for the motion of the car. Moving objects have no
tracks here, and stay in the static cloud.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from lidar_synth.formats.kitti360_poses import CAMERA, write_calibration, write_poses
from lidar_synth.lab.kitti360.accumulated import REACH, write_cloud
from lidar_synth.lab.kitti360.labels import label_scans

DRIVE = "2013_05_28_drive_0004_sync"
FRAMES = range(24, 56, 2)

IDS = {
    "Vegetation": 21,
    "Ground": 6,
    "Road": 7,
    "Lane Line Marking": 7,
    "Stop Line Marking": 7,
    "Other Road Marking": 7,
    "Sidewalk": 8,
    "Driveway": 9,
    "Car": 26,
    "Pickup Truck": 27,
    "Medium-sized Truck": 27,
    "Semi-truck": 27,
    "Bus": 28,
    "Motorcycle": 32,
    "Bicycle": 33,
    "Pedestrian": 24,
    "Pedestrian with Object": 24,
    "Signs": 20,
    "Building": 11,
    "Road Barriers": 13,
    "Temporary Construction Barriers": 13,
}
"""KITTI-360's id of PandaSet's classes; all others are left out."""

POSITION = (0.001, 0.7752, 1.8589)
TURN = (-0.0157, 0.0005, np.pi / 2)
"""The sensor in the frame of PandaSet's poses (x right, y ahead, z up), measured on frame 00:
metres, radians."""


class Poses:
    """The poses of the sensor at any time."""

    def __init__(self, folder: Path) -> None:
        given = json.loads((folder / "poses.json").read_text())
        self.times = np.array(json.loads((folder / "timestamps.json").read_text()))
        self._places = np.array([[p["position"][k] for k in "xyz"] for p in given])
        self._turns = Slerp(
            self.times,
            Rotation.from_quat([[p["heading"][k] for k in "xyzw"] for p in given]),
        )
        z = Rotation.from_euler("z", TURN[2])
        self._mount = (
            Rotation.from_euler("x", TURN[0]) * Rotation.from_euler("y", TURN[1]) * z
        )

    def in_world(
        self, points: NDArray[np.float64], time: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Points (N, 3) in the frame of the sensor at N times, in the world."""
        time = np.clip(time, self.times[0], self.times[-1])
        places = np.column_stack(
            [np.interp(time, self.times, axis) for axis in self._places.T]
        )
        return np.asarray(
            self._turns(time).apply(self._mount.apply(points) + POSITION) + places
        )

    def at(self, frame: int) -> NDArray[np.float64]:
        """(4, 4) sensor to world at a frame."""
        pose = np.eye(4)
        moments = np.full(4, self.times[frame])
        origin, *axes = self.in_world(np.vstack([np.zeros(3), np.eye(3)]), moments)
        pose[:3, :3] = np.transpose(np.array(axes) - origin)
        pose[:3, 3] = origin
        return pose


@pytest.mark.slow
@pytest.mark.skipif(
    "LIDAR_SYNTH_LABELLED_SCANS" not in os.environ, reason="no labelled real scans"
)
def test_labels_of_real_scans_are_recovered(tmp_path: Path) -> None:
    source = Path(os.environ["LIDAR_SYNTH_LABELLED_SCANS"]) / "pandaset"
    published = source / "as_published" / "002"
    names = json.loads(
        (published / "annotations" / "semseg" / "classes.json").read_text()
    )
    ids = np.zeros(256, np.int32)
    ids[[int(k) for k in names]] = [IDS.get(name, 0) for name in names.values()]
    moving = Poses(published / "lidar")
    poses = {frame: moving.at(frame) for frame in FRAMES}
    scans = tmp_path / "data_3d_raw" / DRIVE / "velodyne_points" / "data"
    known = tmp_path / "known" / "data_3d_semantics_scan" / DRIVE / "labels"
    for folder in (scans, known):
        folder.mkdir(parents=True)
    cloud = []
    for frame in FRAMES:
        stored = np.load(source / "sensor_frame" / f"{frame:02d}.npz")
        world = moving.in_world(
            stored["points"].astype(float), moving.times[frame] + stored["time"]
        )
        local = (world - poses[frame][:3, 3]) @ poses[frame][:3, :3]
        np.column_stack([local, np.zeros(len(local))]).astype("<f4").tofile(
            scans / f"{frame:010d}.bin"
        )
        semantic = ids[stored["label"]]
        semantic.astype("<u4").tofile(known / f"{frame:010d}.label")
        if frame % 4 == 0:
            near = np.linalg.norm(local, axis=1) < REACH
            cloud.append(np.column_stack([world[near], semantic[near]]))
    x, y, z, semantic = np.concatenate(cloud).T
    values = {
        "x": x,
        "y": y,
        "z": z,
        "semantic": semantic,
        "instance": 1000 * semantic,
        "confidence": np.ones(len(x)),
    }
    name = f"{FRAMES[0]:010d}_{FRAMES[-1]:010d}.ply"
    write_cloud(
        tmp_path / "data_3d_semantics" / "train" / DRIVE / "static" / name, values
    )
    write_calibration(tmp_path, CAMERA)
    write_poses(tmp_path, DRIVE, poses)
    report = label_scans(
        tmp_path, tmp_path / "labels", against=tmp_path / "known", progress=False
    )
    held_out = [
        counts for frame, counts in report.compared.items() if int(frame[-10:]) % 4
    ]
    points, covered, right = np.sum(held_out, axis=0)[:3]
    print(f"covered {covered / points:.3f}, right {right / covered:.4f}")
    assert (
        len(held_out) == len(FRAMES) / 2
        and covered > 0.75 * points
        and right > 0.97 * covered
    )
