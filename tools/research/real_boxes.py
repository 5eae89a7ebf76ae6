"""Real frames with boxes of cars, of several datasets, as one folder of scans by place.

    python tools/research/real_boxes.py OUT [--kitti360 FOLDER] [--kitti FOLDER ...]

OUT/PLACE/FRAME.npz, for ``lidar-synth prove OUT --task detection``. KITTI-360's frames have the
boxes of ``bboxes_3D_cam0/BBoxes_FRAME.json`` (eight corners in the frame of camera 0). KITTI labels
only what its camera sees: scans are cut to that view, so that no other car counts as background.
Only boxes of cars and vans are kept.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import typer
from numpy.typing import NDArray

from lidar_synth import KITTI360, Boxes, KITTIObject, Scan, load_sensor
from lidar_synth.files.disk import read_matrix
from lidar_synth.formats.npz import write_scan

SENSOR = load_sensor("hdl64e_lasers")
SAME_PLACE = {1134: 947, 1866: 570, 2939: 2903}
"""Frames of drive 0000 that were recorded within 30 m of another one."""
ONE_DRIVE = {623, 1460, 1584, 2443, 2489, 5269, 6025, 6147, 6155, 6920}
"""Frames of KITTI's object set that are of one drive (0048)."""
VIEW = np.radians(40)
"""KITTI's left colour camera sees so far to either side."""
CARS = ("Car", "Van")


def read_corners(path: Path, to_velodyne: NDArray[np.float64]) -> Boxes:
    """The boxes of a file, from the corners of each."""
    values = []
    for entry in json.loads(path.read_text()):
        corners = np.array(entry["corners_cam0"]) @ to_velodyne[:, :3].T
        corners += to_velodyne[:, 3]
        along, across, up = (corners[0] - corners[i] for i in (5, 2, 1))
        size = [np.linalg.norm(edge) for edge in (along, across, up)]
        values.append([*corners.mean(0), *size, np.arctan2(along[1], along[0])])
    return Boxes(np.array(values, np.float32).reshape(-1, 7), ("Car",) * len(values))


def in_view(scan: Scan) -> Scan:
    """The part of a scan that the camera sees."""
    angle = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    return scan[np.abs(angle) < VIEW]


def cars_of(scan: Scan) -> Boxes:
    """The boxes of cars and vans."""
    assert scan.boxes is not None
    return scan.boxes[np.array([name in CARS for name in scan.boxes.names], bool)]


def write(scan: Scan, out: Path, place: str, frame: int) -> None:
    """Write a scan with its cars, as one of the sensor."""
    folder = out / place
    folder.mkdir(parents=True, exist_ok=True)
    own = replace(scan, sensor=SENSOR, boxes=cars_of(scan), image_path=None, pose=None)
    write_scan(folder / f"{frame:06d}.npz", own)


def main(
    out: Path, kitti360: Path | None = None, kitti: list[Path] | None = None
) -> None:
    """Writes the frames of each given folder."""
    if kitti360 is not None:
        given = read_matrix(kitti360 / "calibration" / "calib_cam_to_velo.txt", 12)
        for scan in KITTI360(kitti360):
            frame = int(scan.id.rpartition("/")[2])
            if frame == 2449:  # moving cars have boxes at all their places of the drive
                continue
            path = kitti360 / "bboxes_3D_cam0" / f"BBoxes_{frame}.json"
            scan.boxes = read_corners(path, given.reshape(3, 4))
            write(scan, out, f"kitti360-{SAME_PLACE.get(frame, frame)}", frame)
    for folder in kitti or []:
        for scan in KITTIObject(folder):
            frame = int(scan.id.rpartition("/")[2])
            if scan.boxes is not None:
                place = 48 if frame in ONE_DRIVE else frame
                write(in_view(scan), out, f"kitti-{place}", frame)


if __name__ == "__main__":
    typer.run(main)
