"""Write streets of the town as a nuScenes dataset: key frames, the sweeps between them, and the
tables.

    python tools/trainers/scripts/nuscenes_town.py OUT [--seed 0]

Version v1.0-mini with two scenes, one for training and one for validation. A scene is a second with
two key frames,
as the LiDAR alone sees it: no cameras, and an empty map.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.nuscenes import NAMES, as_nuscenes, five_values
from numpy.typing import NDArray
from PIL import Image
from pyquaternion import Quaternion
from typer import run

from lidar_synth.geometry import Scan
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
        names = """attribute calibrated_sensor category ego_pose instance log map sample
        sample_annotation sample_data scene sensor visibility"""
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


def placed(box: NDArray[np.float64], pose: NDArray[np.float64]) -> dict[str, Any]:
    """Place, size and rotation of a box in the world."""
    length, width, height, yaw = box[3:]
    turn = Quaternion(matrix=pose[:3, :3]) * Quaternion(axis=(0, 0, 1), radians=yaw)
    return {
        "translation": (pose[:3, :3] @ box[:3] + pose[:3, 3]).tolist(),
        "size": [width, length, height],
        "rotation": turn.elements.tolist(),
    }


def write_dataset(out: Path, seed: int = 0) -> None:
    """Writes scans and tables."""
    tables = Tables()
    add_sensor(tables)
    for category, attribute in CATEGORIES.values():
        tables.add("category", category, name=category, description="")
        tables.add("attribute", attribute, name=attribute, description="")
    # The devkit asks for a map of each log.
    tables.add("log", "log", logfile="", vehicle="", date_captured="", location="")
    plan = {"category": "semantic_prior", "filename": "maps/empty.png"}
    tables.add("map", "map", **plan, log_tokens=["log"])
    (out / "maps").mkdir(parents=True, exist_ok=True)
    Image.new("L", (8, 8)).save(out / "maps" / "empty.png")
    scans = STRETCH_FRAMES * len(SCENES)
    town = Town(seed, "hdl32e_nuscenes", scans, interval=INTERVAL)
    for number, name in enumerate(SCENES):
        write_scene(out, tables, town, number, name)
    tables.write(out / VERSION)


def add_sensor(tables: Tables) -> None:
    """Add the LiDAR and its mount."""
    tables.add("visibility", "4", level="v80-100", description="")
    tables.add("sensor", "lidar", channel="LIDAR_TOP", modality="lidar")
    tables.add(
        "calibrated_sensor",
        "mount",
        sensor_token="lidar",
        camera_intrinsic=[],
        translation=[0, 0, HEIGHT],
        rotation=Quaternion(matrix=AHEAD).elements.tolist(),
    )


def write_scene(out: Path, tables: Tables, town: Town, number: int, name: str) -> None:
    """Write the sweeps of a scene, and its rows."""
    frames = []
    samples = []
    tracks = dict[int, list[dict[str, Any]]]()
    for frame in range(STRETCH_FRAMES):
        scan = town[number * STRETCH_FRAMES + frame]
        stamp = int(1e6 * (START + 100 * number + INTERVAL * frame))
        sample = f"{name}-{KEYS[0] if frame <= KEYS[0] else KEYS[1]}"
        if frame in KEYS:
            row = tables.add("sample", sample, timestamp=stamp, scene_token=name)
            samples.append(row)
            annotate(tables, scan, sample, tracks, name)
        row = add_sweep(tables, scan, f"{name}-{frame:02d}", sample, stamp)
        row["is_key_frame"] = frame in KEYS
        file = f"LIDAR_TOP/{name}__LIDAR_TOP__{stamp}.pcd.bin"
        row["filename"] = f"{'samples' if frame in KEYS else 'sweeps'}/{file}"
        frames.append(row)
        path = out / row["filename"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(five_values(as_nuscenes(scan)).astype("<f4").tobytes())
    for rows in (frames, samples, *tracks.values()):
        tables.link(rows)
    add_instances(tables, tracks, name)
    facts = {"name": name, "description": "", "log_token": "log"}
    facts |= {"nbr_samples": len(samples)}
    tables.add("scene", name, **facts, **ends("sample", samples))


def add_sweep(
    tables: Tables, scan: Scan, token: str, sample: str, stamp: int
) -> dict[str, Any]:
    """Add the pose of a sweep, and its row, without what says whether it is a key frame."""
    vehicle = in_world(scan)
    vehicle[:3, 3] -= HEIGHT * vehicle[:3, 2]
    rotation = Quaternion(matrix=vehicle[:3, :3]).elements.tolist()
    place = vehicle[:3, 3].tolist()
    row = tables.add(
        "sample_data",
        token,
        sample_token=sample,
        ego_pose_token=token,
        calibrated_sensor_token="mount",
        timestamp=stamp,
        fileformat="pcd",
        height=0,
        width=0,
    )
    tables.add("ego_pose", token, timestamp=stamp, rotation=rotation, translation=place)
    return row


def add_instances(
    tables: Tables, tracks: dict[int, list[dict[str, Any]]], scene: str
) -> None:
    """Add the objects of a scene."""
    for instance, rows in tracks.items():
        category = CATEGORIES[rows[0].pop("class")][0]
        facts = {"category_token": category, "nbr_annotations": len(rows)}
        token = f"{scene}-{instance}"
        tables.add("instance", token, **facts, **ends("annotation", rows))


def ends(kind: str, rows: list[dict[str, Any]]) -> dict[str, str]:
    """The tokens of the first and the last of some rows."""
    return {
        f"first_{kind}_token": rows[0]["token"],
        f"last_{kind}_token": rows[-1]["token"],
    }


def annotate(
    tables: Tables,
    scan: Scan,
    sample: str,
    tracks: dict[int, list[dict[str, Any]]],
    scene: str,
) -> None:
    """Add the boxes of a key frame to the tables, and to the tracks of their instances."""
    assert scan.boxes is not None
    counts = scan.boxes.contain(scan.points).sum(1)
    for i, kind in enumerate(scan.boxes.names):
        if NAMES[kind] not in CATEGORIES or not counts[i]:
            continue
        instance = int(scan.boxes.instance[i])
        row = tables.add(
            "sample_annotation",
            f"{sample}-{instance}",
            sample_token=sample,
            instance_token=f"{scene}-{instance}",
            visibility_token="4",
            attribute_tokens=[CATEGORIES[NAMES[kind]][1]],
            num_radar_pts=0,
            num_lidar_pts=int(counts[i]),
            **placed(scan.boxes.values[i].astype(float), in_world(scan)),
        )
        tracks.setdefault(instance, []).append(row)
        if len(tracks[instance]) == 1:
            row["class"] = NAMES[kind]


def in_world(scan: Scan) -> Any:
    """(4, 4) sensor to world."""
    assert scan.pose is not None
    return np.asarray(scan.pose, float).copy()


if __name__ == "__main__":
    run(write_dataset)
