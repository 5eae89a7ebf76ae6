"""nuScenes' info list for MMDetection3D's LiDAR detectors, from the dataset's tables by nuScenes'
own devkit.

It is the list of ``create_data.py nuscenes`` without cameras, so that a dataset with a LiDAR alone
has one, too.
"""

from pathlib import Path
from typing import Any

import numpy as np
from lidar_synth.integrations.mmdet3d_lists import write_list
from lidar_synth.integrations.nuscenes import CLASSES
from numpy.typing import NDArray

from lidar_synth.errors import DataError, FileError, LibraryError

SENSOR = "LIDAR_TOP"
SPLITS = {
    "v1.0-trainval": {"train": "train", "val": "val"},
    "v1.0-mini": {"train": "mini_train", "val": "mini_val"},
}
"""The devkit's name of a split, by version."""


def nuscenes_list(
    root: str | Path,
    out: str | Path,
    split: str = "train",
    version: str = "v1.0-trainval",
    sweeps: int = 10,
) -> Path:
    """Write the list of a nuScenes folder; its paths are names of files, as in the trainer's own
    list.

    Args:
        root: the folder that holds ``samples``, ``sweeps`` and the tables.
        out: the list's file, ``.json`` or ``.pkl``.
        split: ``train`` or ``val``.
        version: ``v1.0-trainval`` or ``v1.0-mini``, the folder of the tables.
        sweeps: maximum number of sweeps before each key frame.

    Raises:
        LibraryError: if the devkit is not installed.
        FileError: if there are no tables.
        DataError: on another split or version, or a split without scenes.
    """
    try:
        from nuscenes.nuscenes import NuScenes
        from nuscenes.utils.splits import create_splits_scenes
    except ImportError as error:
        raise LibraryError(
            f"nuScenes' devkit ({error})",
            "nuscenes-devkit 1.2",
            "bash tools/install_mmdet3d.sh",
        ) from error
    if split not in SPLITS.get(version, {}):
        raise DataError(
            f"split {split!r} of {version!r}",
            "train or val of v1.0-trainval or v1.0-mini",
        )
    if not (Path(root) / version).is_dir():
        raise FileError(
            f"{Path(root) / version} is not a folder", f"nuScenes' tables of {version}"
        )
    tables = NuScenes(version, str(root), verbose=False)
    scenes = set(create_splits_scenes()[SPLITS[version][split]])
    samples = [
        each
        for each in tables.sample
        if tables.get("scene", each["scene_token"])["name"] in scenes
    ]
    if not samples:
        raise DataError(
            f"{root} has no scene of {split} in {version}",
            f"some of {', '.join(sorted(scenes)[:3])}, ...",
        )
    entries = [
        _entry(tables, sample, sweeps) | {"sample_idx": i}
        for i, sample in enumerate(samples)
    ]
    return write_list(
        out, "nuscenes", entries, {name: i for i, name in enumerate(CLASSES)}
    )


def _entry(tables: Any, sample: dict[str, Any], sweeps: int) -> dict[str, Any]:
    frame = tables.get("sample_data", sample["data"][SENSOR])
    in_ego, in_world = _poses(tables, frame)
    points = {
        "lidar_path": Path(frame["filename"]).name,
        "num_pts_feats": 5,
        "lidar2ego": in_ego.tolist(),
    }
    entry = {
        "token": sample["token"],
        "timestamp": frame["timestamp"] / 1e6,
        "ego2global": in_world.tolist(),
    }
    entries: list[dict[str, Any]] = []
    earlier = frame
    while earlier["prev"] and len(entries) < sweeps:
        earlier = tables.get("sample_data", earlier["prev"])
        entries.append(_sweep(tables, earlier, in_world @ in_ego))
    if entries:  # without the key, the trainer repeats the key frame
        entry["lidar_sweeps"] = entries
    return entry | {"lidar_points": points, "instances": _instances(tables, frame)}


def _sweep(
    tables: Any, frame: dict[str, Any], key: NDArray[np.float64]
) -> dict[str, Any]:
    in_ego, in_world = _poses(tables, frame)
    sensor_from_key = np.linalg.inv(in_world @ in_ego) @ key
    points = {"lidar_path": frame["filename"], "lidar2sensor": sensor_from_key.tolist()}
    return {"timestamp": frame["timestamp"] / 1e6, "lidar_points": points}


def _instances(tables: Any, frame: dict[str, Any]) -> list[dict[str, Any]]:
    """The boxes of a key frame in its sensor's frame, with the trainer's ten classes or -1."""
    from nuscenes.eval.detection.utils import category_to_detection_name

    _, boxes, _ = tables.get_sample_data(frame["token"])
    in_ego, in_world = _poses(tables, frame)
    turn = np.linalg.inv((in_world @ in_ego)[:3, :3])
    instances = []
    for box in boxes:
        name = category_to_detection_name(box.name)
        row = tables.get("sample_annotation", box.token)
        width, length, height = box.wlh
        ahead = box.orientation.rotation_matrix[:, 0]
        label = -1 if name is None else CLASSES.index(name)
        instance = {
            "bbox_3d": [
                *box.center,
                length,
                width,
                height,
                np.arctan2(ahead[1], ahead[0]),
            ]
        }
        instance["velocity"] = (turn @ tables.box_velocity(box.token))[:2]
        instance = {
            key: np.asarray(values, float).tolist() for key, values in instance.items()
        }
        counts = {
            "num_lidar_pts": row["num_lidar_pts"],
            "num_radar_pts": row["num_radar_pts"],
        }
        valid = sum(counts.values()) > 0
        instances.append(
            instance
            | counts
            | {"bbox_3d_isvalid": valid, "bbox_label": label, "bbox_label_3d": label}
        )
    return instances


def _poses(
    tables: Any, frame: dict[str, Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(4, 4) sensor to vehicle and vehicle to world, metres."""
    from nuscenes.utils.geometry_utils import transform_matrix
    from pyquaternion import Quaternion

    rows = [
        tables.get("calibrated_sensor", frame["calibrated_sensor_token"]),
        tables.get("ego_pose", frame["ego_pose_token"]),
    ]
    sensor, vehicle = (
        transform_matrix(row["translation"], Quaternion(row["rotation"]))
        for row in rows
    )
    return sensor, vehicle
