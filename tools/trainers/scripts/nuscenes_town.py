"""Write streets of the town as a nuScenes dataset: key frames, the sweeps between them, and the
tables.

    python tools/trainers/scripts/nuscenes_town.py OUT [--seed 0]

Version v1.0-mini with two scenes, one for training and one for validation. A scene is a second with
two key frames,
as the LiDAR alone sees it: no cameras, and an empty map.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.nuscenes import NAMES, as_nuscenes, five_values
from PIL import Image
from pyquaternion import Quaternion

from lidar_synth.geometry.scan import Scan
from lidar_synth.lab.town import Town
from lidar_synth.lab.town.world import STRETCH_FRAMES

VERSION = "v1.0-mini"
SCENES = ("scene-0061", "scene-0103")
"""One of the devkit's scenes for training in this version, and one for validation."""
KEYS = (9, 19)
"""Key frames of a scene of 20 sweeps; nine sweeps precede each."""
INTERVAL = 0.05
START = 1_532_402_927.0
HEIGHT = 1.73
CATEGORIES = {
    "car": ("vehicle.car", "vehicle.parked"),
    "truck": ("vehicle.truck", "vehicle.parked"),
    "pedestrian": ("human.pedestrian.adult", "pedestrian.moving"),
    "bicycle": ("vehicle.bicycle", "cycle.with_rider"),
}
"""nuScenes' category and an attribute of it, by detection class."""
AHEAD = np.array([(0.0, 1, 0), (-1, 0, 0), (0, 0, 1)])
"""nuScenes' LiDAR axes (x right, y forward) in the vehicle's (x forward, y left)."""


class Tables:
    """The tables of a version, as lists of rows with tokens."""

    def __init__(self) -> None:
        names = """attribute calibrated_sensor category ego_pose instance log map sample sample_annotation sample_data
        scene sensor visibility"""
        self.rows: dict[str, list[dict[str, Any]]] = {
            name: [] for name in names.split()
        }

    def add(self, table: str, token: str, **values: Any) -> dict[str, Any]:
        """Add a row."""
        self.rows[table].append({"token": token, **values})
        return self.rows[table][-1]

    def link(self, rows: list[dict[str, Any]]) -> None:
        """Set ``prev`` and ``next`` of rows in their order in time."""
        for i, row in enumerate(rows):
            row["prev"] = rows[i - 1]["token"] if i else ""
            row["next"] = rows[i + 1]["token"] if i + 1 < len(rows) else ""

    def write(self, folder: Path) -> None:
        """Write each table as JSON."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, rows in self.rows.items():
            (folder / f"{name}.json").write_text(json.dumps(rows))


def write_dataset(out: Path, seed: int) -> None:
    """Write scans and tables to ``out``."""
    tables = Tables()
    tables.add("visibility", "4", level="v80-100", description="")
    tables.add("sensor", "lidar", channel="LIDAR_TOP", modality="lidar")
    mount = {
        "translation": [0, 0, HEIGHT],
        "rotation": Quaternion(matrix=AHEAD).elements.tolist(),
    }
    tables.add(
        "calibrated_sensor", "mount", sensor_token="lidar", camera_intrinsic=[], **mount
    )
    for category, attribute in CATEGORIES.values():
        tables.add("category", category, name=category, description="")
        tables.add("attribute", attribute, name=attribute, description="")
    town = Town(
        seed=seed,
        sensor="hdl32e_nuscenes",
        scans=STRETCH_FRAMES * len(SCENES),
        interval=INTERVAL,
    )
    # The devkit asks for a map of each log.
    tables.add("log", "log", logfile="", vehicle="", date_captured="", location="")
    tables.add(
        "map",
        "map",
        category="semantic_prior",
        filename="maps/empty.png",
        log_tokens=["log"],
    )
    (out / "maps").mkdir(parents=True, exist_ok=True)
    Image.new("L", (8, 8)).save(out / "maps" / "empty.png")
    for number, name in enumerate(SCENES):
        write_scene(out, tables, town, number, name)
    tables.write(out / VERSION)


def write_scene(out: Path, tables: Tables, town: Town, number: int, name: str) -> None:
    """Write the sweeps of a scene, and its rows."""
    frames = []
    samples = []
    tracks = dict[int, list[dict[str, Any]]]()
    for frame in range(STRETCH_FRAMES):
        scan = town[number * STRETCH_FRAMES + frame]
        stamp = int(1e6 * (START + 100 * number + INTERVAL * frame))
        key = frame in KEYS
        sample = f"{name}-{KEYS[0] if frame <= KEYS[0] else KEYS[1]}"
        if key:
            samples.append(
                tables.add("sample", sample, timestamp=stamp, scene_token=name)
            )
            annotate(tables, scan, sample, tracks, name)
        token = f"{name}-{frame:02d}"
        file = f"{'samples' if key else 'sweeps'}/LIDAR_TOP/{name}__LIDAR_TOP__{stamp}.pcd.bin"
        frames.append(
            tables.add(
                "sample_data",
                token,
                sample_token=sample,
                ego_pose_token=token,
                calibrated_sensor_token="mount",
                timestamp=stamp,
                fileformat="pcd",
                is_key_frame=key,
                height=0,
                width=0,
                filename=file,
            )
        )
        vehicle = in_world(scan)
        vehicle[:3, 3] -= HEIGHT * vehicle[:3, 2]
        rotation = Quaternion(matrix=vehicle[:3, :3]).elements.tolist()
        tables.add(
            "ego_pose",
            token,
            timestamp=stamp,
            rotation=rotation,
            translation=vehicle[:3, 3].tolist(),
        )
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        (out / file).write_bytes(five_values(as_nuscenes(scan)).astype("<f4").tobytes())
    for rows in (frames, samples, *tracks.values()):
        tables.link(rows)
    for instance, rows in tracks.items():
        ends = {
            "first_annotation_token": rows[0]["token"],
            "last_annotation_token": rows[-1]["token"],
        }
        tables.add(
            "instance",
            f"{name}-{instance}",
            category_token=CATEGORIES[rows[0].pop("class")][0],
            nbr_annotations=len(rows),
            **ends,
        )
    ends = {
        "first_sample_token": samples[0]["token"],
        "last_sample_token": samples[-1]["token"],
    }
    tables.add(
        "scene",
        name,
        name=name,
        description="",
        log_token="log",
        nbr_samples=len(samples),
        **ends,
    )


def annotate(
    tables: Tables,
    scan: Scan,
    sample: str,
    tracks: dict[int, list[dict[str, Any]]],
    scene: str,
) -> None:
    """Add the boxes of a key frame to the tables, and to the tracks of their instances."""
    assert scan.boxes is not None
    pose = in_world(scan)
    counts = scan.boxes.contain(scan.points).sum(1)
    for i, kind in enumerate(scan.boxes.names):
        if NAMES[kind] not in CATEGORIES or not counts[i]:
            continue
        x, y, z, length, width, height, yaw = scan.boxes.values[i].astype(float)
        instance = int(scan.boxes.instance[i])
        turn = Quaternion(matrix=pose[:3, :3]) * Quaternion(axis=(0, 0, 1), radians=yaw)
        row = tables.add(
            "sample_annotation",
            f"{sample}-{instance}",
            sample_token=sample,
            instance_token=f"{scene}-{instance}",
            visibility_token="4",
            attribute_tokens=[CATEGORIES[NAMES[kind]][1]],
            num_radar_pts=0,
            translation=(pose[:3, :3] @ (x, y, z) + pose[:3, 3]).tolist(),
            size=[width, length, height],
            rotation=turn.elements.tolist(),
            num_lidar_pts=int(counts[i]),
        )
        tracks.setdefault(instance, []).append(row)
        if len(tracks[instance]) == 1:
            row["class"] = NAMES[kind]


def in_world(scan: Scan) -> Any:
    """(4, 4) sensor to world."""
    assert scan.pose is not None
    return np.asarray(scan.pose, float).copy()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    write_dataset(options.out, options.seed)
